import numpy as np
import pytest

from faintspot.loop.simulation import LoopConfiguration
from faintspot.loop.simulation.telescope import (
    camera_calibration,
    make_detector,
)
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels, Thresholded
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumAPosteriori, MaximumLikelihood
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation


@pytest.mark.parametrize(
    ("faint", "bright"),
    [
        (TotalVariation(noise_std=3.0, keep_brightest=9), BrightestPixels(keep_brightest=9)),
        (TotalVariation(noise_std="auto", keep_brightest="auto"), BrightestPixels()),
        (Smoothed(smoothing_px=0.8, keep_brightest="auto"), Smoothed(smoothing_px=0.8)),
        (Thresholded(threshold_e=20.0), Thresholded(threshold_e=0.0)),
        (MaximumAPosteriori(prior_std_px=0.1, model_error=0.3), MaximumAPosteriori(model_error=0.3)),
        (MaximumLikelihood(model_error=0.2), MaximumLikelihood(model_error=0.2)),
    ],
    ids=lambda estimator: estimator.name,
)
def test_references_leave_out_what_is_for_faint_flux(faint: Estimator, bright: Estimator) -> None:
    assert faint.for_bright_flux() == bright


def test_calibrated_frames_hold_the_electrons_of_the_star() -> None:
    """The mean of a noisy camera's frames is that of the star, to five standard errors."""
    camera = {
        "photons_per_subaperture": 1.0, "read_noise_e": 12.0, "em_gain": 8.0, "gain_e_per_adu": 0.25,
        "offset_adu": 70.0, "background_e": 3.0, "dark_e": 2.0,
    }  # fmt: skip
    loop = LoopConfiguration().replace("camera", **camera)
    star = np.array([[0.0, 4.0], [20.0, 100.0]])
    detector, calibration = make_detector(loop), camera_calibration(loop)
    adu = 70.0 + (star + 5.0) * 8.0 / 0.25
    np.testing.assert_allclose((adu - calibration.dark) * 0.25 / 8.0, star, atol=1e-5)
    assert (calibration.gain_e_per_adu, calibration.em_gain, calibration.read_noise_e) == (0.25, 8.0, 12.0)
    assert calibration.background_e == 5.0
    noisy = detector.expose(np.broadcast_to(star[..., None], (2, 2, 20000)), np.random.default_rng(2))
    variance = 2 * (star + 5.0) + 1.5**2
    error = np.sqrt(variance / 20000) * 8.0 / 0.25
    assert (np.abs(noisy.mean(axis=-1) - adu) < 5 * error).all()
