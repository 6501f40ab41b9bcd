"""The Cramer-Rao bound: closed forms, limits, a fit that reaches it; photon efficiency."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.refusals import assert_each_refused, refused

from faintspot.slopes.simulate import Detector
from faintspot.slopes.spots.bounds import MEAN_ABSOLUTE, cramer_rao, cramer_rao_covariance, photon_efficiency
from faintspot.slopes.spots.psf import PSF

PIXEL_VARIANCE = 1 / 12  # of a position within a pixel: widens a well-sampled spot
GAUSSIAN_STD = 3 / math.sqrt(2 * math.log(2))  # of a "gaussian" spot of size 3
WIDE: dict[str, Any] = {"profile": "gaussian", "size": 3.0, "shape": (36, 36)}


def test_photon_noise_of_a_gaussian_spot() -> None:
    bound = cramer_rao([50.0, 5000.0], detector=Detector(0.0), **WIDE)
    std = math.sqrt(GAUSSIAN_STD**2 + PIXEL_VARIANCE)
    expected = std / np.sqrt([[50.0], [5000.0]])
    # Well sampled (2.5 px standard deviation): the next order in the pixel's size is below 1e-4.
    np.testing.assert_allclose(bound, np.broadcast_to(expected, (2, 2)), rtol=1e-3)


def test_read_noise_of_a_gaussian_spot() -> None:
    read_noise, flux = 60.0, 100.0
    variance = GAUSSIAN_STD**2 + PIXEL_VARIANCE
    # Sum of squared derivatives: flux^2 / (8 pi std^4).
    expected = read_noise * math.sqrt(8 * math.pi) * variance / flux
    bound = cramer_rao(flux, detector=Detector(read_noise), **WIDE)
    # The photons in the brightest pixel are 2.5 of a variance of 3600.
    np.testing.assert_allclose(bound, expected, rtol=2e-3)


def test_a_background_costs_nothing_for_a_spot_in_the_middle() -> None:
    flux = cramer_rao(100.0, positions=(0.3, -0.6))
    background = cramer_rao(100.0, positions=(0.3, -0.6), unknown_background=True)
    assert np.all(flux < background)
    centred = [cramer_rao(100.0, unknown_background=unknown) for unknown in (False, True)]
    np.testing.assert_allclose(centred[0], centred[1], rtol=1e-9)


def test_exact_and_gaussian_noise_agree_with_much_flux_only() -> None:
    detector = Detector(1.0)
    ratio = [
        float((cramer_rao(f, detector=detector, noise="gaussian") / cramer_rao(f, detector=detector)).mean())
        for f in (20.0, 1e5)
    ]
    assert ratio[0] > 1.03
    # Dark wings hold a few thousandths of the information even then.
    assert ratio[1] == pytest.approx(1, abs=5e-3)


def test_a_multiplication_register_costs_half_the_flux() -> None:
    counting = cramer_rao(50.0, detector=Detector(0.0), noise="gaussian")
    multiplied = cramer_rao(100.0, detector=Detector(0.0, em_gain=300.0))
    np.testing.assert_allclose(multiplied, counting, rtol=1e-6)


def test_background_and_read_noise_of_the_detector_count() -> None:
    plain = cramer_rao(100.0, detector=Detector(1.0))
    sky = cramer_rao(100.0, detector=Detector(1.0, background_e=2.0, dark_e=1.0))
    same = cramer_rao(100.0, detector=Detector(2.0), noise="gaussian")
    assert np.all(plain < sky)
    # 3 e- of background and 1 e-^2 of read noise are a variance of 4.
    gaussian = cramer_rao(100.0, detector=Detector(1.0, background_e=2.0, dark_e=1.0), noise="gaussian")
    np.testing.assert_allclose(gaussian, same, rtol=1e-6)
    # Converter steps of 1 e- at 1 e- of noise: one twelfth more variance.
    steps = cramer_rao(100.0, detector=Detector(1.0, bits=16, offset_adu=100.0), noise="gaussian")
    rounded = cramer_rao(100.0, detector=Detector(math.sqrt(13 / 12)), noise="gaussian")
    np.testing.assert_allclose(steps, rounded, rtol=1e-6)
    noisy = np.ones((16, 16))
    noisy[7:9, 7:9] = 3.0
    assert np.all(cramer_rao(100.0, detector=Detector(noisy)) > plain)


def test_elongation_makes_one_axis_worse() -> None:
    bound = cramer_rao(100.0, elongation=2.0)
    assert bound[0] > 1.7 * bound[1]
    turned = cramer_rao(100.0, elongation=2.0, angle_deg=90.0)
    np.testing.assert_allclose(turned, bound[::-1], rtol=1e-6)
    oblique = cramer_rao(100.0, elongation=2.0, angle_deg=45.0, size=1.5)
    np.testing.assert_allclose(oblique[0], oblique[1], rtol=1e-3)


def test_a_range_of_positions_is_the_mean_over_them() -> None:
    bound = cramer_rao([10.0, 300.0], position_range_px=2.0)
    random = np.random.default_rng(2).uniform(-2, 2, (400, 2))
    # 400 positions: the bound varies by 1 % over a pixel.
    np.testing.assert_allclose(bound, cramer_rao([10.0, 300.0], positions=random), rtol=3e-3)
    np.testing.assert_allclose(cramer_rao(10.0, position_range_px=0.0), cramer_rao(10.0), rtol=1e-12)


def test_a_spot_that_is_not_in_its_image() -> None:
    far: dict[str, Any] = {"profile": "gaussian", "positions": (300.0, 0.0)}
    assert np.all(np.isinf(cramer_rao(10.0, **far)))


def test_a_spot_given_by_its_images() -> None:
    psf = PSF.analytic(size=1.2, radius_px=12)
    bound = cramer_rao([10.0, 500.0], psf=psf, position_range_px=1.0)
    # The PSF ends at 12 px, and the flux is that of the window.
    np.testing.assert_allclose(bound, cramer_rao([10.0, 500.0], size=1.2, position_range_px=1.0), rtol=1e-3)


def test_negative_wings_tell_nothing() -> None:
    """Of learnt spots, for example."""
    samples = PSF.analytic(size=1.2, radius_px=8).samples
    bounds = [
        cramer_rao([10.0, 500.0], psf=PSF(samples - part * samples.max(), 8), detector=Detector(0.0))
        for part in (2e-3, 0.0)
    ]
    # A tenth of the flux, which is normalised, is taken from the wings, whose lost part had information.
    np.testing.assert_allclose(bounds[0], bounds[1], rtol=0.3)


@given(flux=st.floats(1, 1e4), read_noise=st.sampled_from([0.0, 0.1, 1.0, 3.0]), share=st.floats(0.1, 1))
def test_efficiency_is_the_share_of_flux_needed(flux: float, read_noise: float, share: float) -> None:
    detector = Detector(read_noise)
    error = MEAN_ABSOLUTE * cramer_rao(share * flux, detector=detector).mean()
    assert photon_efficiency(error, flux, detector=detector) == pytest.approx(share, rel=2e-3)


def test_efficiencies_of_many_estimators_at_once() -> None:
    flux = np.array([20.0, 100.0, 3000.0])
    error = MEAN_ABSOLUTE * cramer_rao(0.7 * flux).mean(axis=-1)
    np.testing.assert_allclose(photon_efficiency(error, flux), 0.7, rtol=1e-3)
    np.testing.assert_allclose(
        photon_efficiency(error[:, None], [10.0, 20.0]), 0.7 * flux[:, None] / [10, 20], rtol=1e-3
    )


def test_wrong_values_are_refused() -> None:
    assert_each_refused(
        partial(cramer_rao, 10.0),
        shape=[(2, 9)],
        profile=["moffat"],
        size=[0.0],
        noise=["none"],
        detector=["ccd"],
        positions=[[1.0, 2.0, 3.0]],
        position_range_px=[-1.0],
    )
    assert_each_refused(cramer_rao, flux_e=[0.0])
    with refused("psf: expected no size beside it"):
        cramer_rao(10.0, psf=PSF.analytic(), size=1.2)
    assert_each_refused(partial(photon_efficiency, flux_e=10.0), error_px=[0.0, 1e-20, 1e20])
    with refused("error_px, flux_e"):
        photon_efficiency([0.1, 0.2], [1.0, 2.0, 3.0])
    assert_each_refused(partial(cramer_rao_covariance, psf=PSF.analytic()), flux_e=[0.0, [1.0, 1.0]])


def test_the_covariance_of_elongated_spots_is_that_of_their_axes() -> None:
    turned = [0.0, 30.0, 90.0]
    psf = PSF.analytic("gaussian", elongation=[3.0] * 3, angle_deg=turned, radius_px=14, index=[0, 1, 2])
    detector = Detector(read_noise_e=1.0)
    found = cramer_rao_covariance([300.0, 300.0, 300.0], psf, (20, 20), detector=detector)
    expected = cramer_rao(300.0, shape=(20, 20), elongation=3.0, profile="gaussian", detector=detector)
    np.testing.assert_allclose(np.sqrt(np.diagonal(found[0])), expected, rtol=5e-3)
    cosine, sine = np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0))
    turn = np.array([[cosine, -sine], [sine, cosine]])
    # The pixels hardly matter at this width.
    np.testing.assert_allclose(found[1], turn @ found[0] @ turn.T, rtol=0.02)
    np.testing.assert_allclose(found[2], found[0][::-1, ::-1], rtol=1e-3, atol=1e-9)
