"""Residual wavefront of a loop, without the noise of the slopes."""

from __future__ import annotations

import numpy as np
import pytest
from tests.loop.telemetry.advice_cases import LAYOUT, seen_with_truth

import faintspot as fs
from faintspot.loop.telemetry.residual import residual_wavefront, wavefront_modes
from faintspot.slopes.pipeline.slopes import RESULT_TYPES

MODES, UNIT = wavefront_modes(LAYOUT)


def test_modes_are_those_of_the_wavefront_fit() -> None:
    slopes = np.random.default_rng(2).standard_normal(2 * len(LAYOUT))
    n = len(LAYOUT)
    measured = fs.Slopes(*(np.zeros(n, kind) for kind in RESULT_TYPES))
    measured.x[:], measured.y[:] = slopes[:n], slopes[n:]
    found = fs.slopes.wavefront.fit_wavefront(measured, LAYOUT)
    np.testing.assert_allclose(MODES @ slopes, found.coefficients[0], rtol=1e-4, atol=1e-5)
    assert found.unit == UNIT


@pytest.mark.parametrize(
    ("noise_px", "extra_px", "gain"), [(0.05, 0.0, 1.0), (0.3, 0.0, 1.0), (0.05, 0.1, 1.0), (0.1, 0.05, 0.5)]
)
def test_noise_is_subtracted(noise_px: float, extra_px: float, gain: float) -> None:
    """Only what the mirror leaves or adds counts, whatever the noise of the slopes and their centroid gain.

    The parabola through the atmosphere's neighbours is off by less than a per cent of what is left here; the
    rest is the scatter of the noise, of which four standard errors are allowed.
    """
    seen, residual = seen_with_truth(noise_px, extra_px, gain)
    left = residual_wavefront(seen, MODES, gain)
    truth = np.square(residual @ MODES.T).sum(axis=1)
    error = np.nanstd(left - truth) / np.sqrt(np.isfinite(left).sum())
    assert np.nanmean(left) == pytest.approx(truth[np.isfinite(left)].mean(), rel=0.05, abs=4 * error)


def test_only_whole_segments_count() -> None:
    seen, _ = seen_with_truth(frames=600)
    left = residual_wavefront(seen, MODES)
    assert np.isnan(left[seen.since < 20]).all()
    assert np.isnan(left[[58, 59, 118, 119]]).all()
    assert np.isfinite(left[25:58]).all()
