import pytest

from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumAPosteriori, MaximumLikelihood
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.thresholded import Thresholded
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
