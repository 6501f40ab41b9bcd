"""The centroid gain from frames that are moved against their windows."""

from __future__ import annotations

import numpy as np
import pytest
from tests.loop.telemetry.advice_cases import LAYOUT
from tests.simulated import frames_of

import faintspot as fs
from faintspot.loop.control.configuration import prior_std_px
from faintspot.loop.telemetry.centroid_gain import calibration_of_electrons, electrons_of, shifted_gain

CALIBRATION = fs.Calibration(dark=100.0, gain_e_per_adu=2.0, read_noise_e=1.0)
PSF = fs.PSF.analytic(size=1.0)


def frames(flux_e: float, count: int = 20) -> np.ndarray:
    """Frames in ADU."""
    made, _ = frames_of(
        LAYOUT,
        count,
        flux_e=flux_e,
        position_range_px=0.5,
        detector=fs.slopes.simulate.Detector(1.0, offset_adu=100.0, gain_e_per_adu=2.0),
        rng=np.random.default_rng(3),
    )
    return electrons_of(made, CALIBRATION)


def pipeline(settings: fs.Settings) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, settings, calibration_of_electrons(CALIBRATION), psf=PSF)


def test_an_estimator_that_sees_everything_has_one() -> None:
    """Maximum likelihood; also with a prior that draws it to the reference, which is taken out."""
    seen = frames(500.0)
    assert seen.mean() * np.prod(LAYOUT.frame_shape) == pytest.approx(500.0 * len(LAYOUT), rel=0.05)
    for settings in (fs.Settings("ml"), fs.Settings("map", prior_std_px=0.3, flux_e=500.0)):
        made = pipeline(settings)
        gain = shifted_gain(made, seen, prior_std_px(settings, LAYOUT))
        assert gain is not None
        # 20 frames of 36 spots of 500 e-; the posterior of a shift of 1 px is not quite a Gaussian.
        assert gain.value == pytest.approx(1.0, abs=0.05)
        assert gain.standard_error < 0.01


def test_a_window_shows_less_and_is_told_how_much() -> None:
    settings = fs.Settings("window", centroid_gain=1.0, flux_e=500.0)
    gain = shifted_gain(pipeline(settings), frames(500.0))
    assert gain is not None
    assert 0.1 < gain.value < 0.6
    told = settings.replace(centroid_gain=gain.value)
    corrected = shifted_gain(pipeline(told), frames(500.0))
    assert corrected is not None
    assert corrected.value == pytest.approx(1.0, abs=1e-4)


def test_what_cannot_be_known() -> None:
    assert shifted_gain(pipeline(fs.Settings("ml")), frames(500.0, 4)) is None
    dark = np.full((6, *LAYOUT.frame_shape), np.nan, np.float32)
    assert shifted_gain(pipeline(fs.Settings("ml")), dark) is None
