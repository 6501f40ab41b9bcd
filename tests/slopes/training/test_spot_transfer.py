"""Gain and read noise of simulated cameras whose spots move by more than photon transfer allows."""

import numpy as np
import pytest

from faintspot.base.errors import InputError
from faintspot.slopes.simulate import Detector, subapertures
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.speckled import speckled_spots
from faintspot.slopes.training.psf_learning import fit_spots
from faintspot.slopes.training.spot_transfer import measure_on_spots, variance_over_expected


def images_of(movement_px: float, gain: float, flux_e: float, n: int = 800) -> np.ndarray:
    """Return images in ADU, dark level taken off, of spots about one place."""
    rng = np.random.default_rng(2)
    positions = 0.3 + movement_px * rng.standard_normal((n, 2))
    camera = Detector(read_noise_e=4.0, background_e=2.0)
    images, _ = subapertures(n, flux_e=flux_e, positions=positions, detector=camera, rng=rng)
    return images / gain


@pytest.mark.slow
@pytest.mark.parametrize(("movement_px", "gain", "flux_e"), [(0.15, 0.5, 2000.0), (1.0, 2.0, 500.0)])
def test_movement_does_not_bias_the_gain(movement_px: float, gain: float, flux_e: float) -> None:
    found = measure_on_spots(images_of(movement_px, gain, flux_e), rng=np.random.default_rng(1))
    assert found.problem is None
    # Two standard errors of 2 %, and as much of what noise in the fitted light does to the line.
    assert found.gain_e_per_adu == pytest.approx(gain, rel=0.08)
    assert 0.01 * gain < found.gain_e_per_adu_error < 0.05 * gain
    # The background's photons count as read noise: sqrt(16 + 2).
    assert found.read_noise_adu * gain == pytest.approx(np.sqrt(18.0), rel=0.03)
    assert found.background_adu * gain == pytest.approx(2.0, abs=0.25)  # the PSF's wings are in it


@pytest.mark.slow
def test_what_cannot_be_told_is_said() -> None:
    rng = np.random.default_rng(3)
    unit, _ = speckled_spots(600, d_over_r0=3.0, shape=(16, 16), size=1.0, rng=rng)
    speckled = Detector(read_noise_e=4.0).expose(1000 * unit, rng)
    found = measure_on_spots(speckled, rng=rng)
    assert found.problem is not None
    assert "shape changes" in found.problem
    faint = measure_on_spots(images_of(0.3, 1.0, 60.0), rng=rng)
    assert faint.problem is not None
    assert "too faint" in faint.problem
    with pytest.raises(InputError, match="at least 20"):
        measure_on_spots(images_of(0.3, 1.0, 500.0, n=10), rng=rng)


@pytest.mark.slow
def test_noise_about_fitted_spots_is_the_camera_s() -> None:
    images = images_of(0.5, 1.0, 1000.0)
    fitted = fit_spots(images, PSF.analytic(radius_px=16))
    assert fitted.background_e[0] == pytest.approx(2.0, abs=0.3)
    assert fitted.flux_e.mean() == pytest.approx(1000.0, rel=0.04)  # the window cuts some light off
    ratio = variance_over_expected(images, fitted, dark_variance_e2=18.0, excess_noise=1.0)
    assert ratio == pytest.approx(
        1.0, abs=0.06
    )  # 800 images of some 20 lit pixels: 1 %, and the PSF's tables
    doubled = variance_over_expected(
        2 * images, fit_spots(2 * images, PSF.analytic(radius_px=16)), dark_variance_e2=72.0, excess_noise=1.0
    )
    assert doubled > 1.3  # electrons that are counted twice are noisier than electrons
