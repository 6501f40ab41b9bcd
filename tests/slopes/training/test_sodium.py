"""Sodium profiles learnt from mean images: exact without noise, near the truth with it, and checked."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

import faintspot as fs
from faintspot.slopes.training import MeanImages, fit_sodium_profile, fit_spot

SIDE = 10
PLACE = (np.arange(6) - 2.5) * 1.3
PLACES = np.stack(np.meshgrid(PLACE, PLACE), axis=-1).reshape(-1, 2)
STAR = fs.LaserGuideStar(PLACES, [-4.5, 0.0], 0.5, fs.PSF.analytic("gaussian", size=1.2, radius_px=6))
ALTITUDES = np.linspace(76e3, 104e3, 41)
TRUE = STAR.focused(fs.SodiumProfile.peaks([86e3, 94e3], [5e3, 4e3], [0.6, 0.4]))
START = fs.SodiumProfile.gaussian().at(ALTITUDES)
FLUX_E, NOISE_E, FRAMES = 150.0, 1.0, 2000


def mean_images(frames: int | None = None, slopes: Any = 0.0, star: Any = STAR) -> MeanImages:
    """The mean of many frames, without noise or with it."""
    positions = np.zeros((len(PLACES), 2)) + slopes
    images = FLUX_E * star.images(TRUE, (SIDE, SIDE), positions)
    if frames is not None:
        rng = np.random.default_rng(1)
        images = rng.normal(rng.poisson(frames * images) / frames, NOISE_E / np.sqrt(frames))
    return MeanImages(images, positions, frames=FRAMES if frames is None else frames)


def distance(found: fs.SodiumProfile, true: fs.SodiumProfile = TRUE) -> float:
    """Part of the flux that is at other altitudes."""
    fine = np.linspace(76e3, 104e3, 1001)
    densities = [np.interp(fine, each.altitudes_m, each.density, 0.0, 0.0) for each in (found, true)]
    return float(0.5 * np.trapezoid(np.abs(densities[0] - densities[1]), fine))


def test_a_double_peak_is_found_from_a_single_one() -> None:
    assert distance(START) > 0.2
    found = fit_sodium_profile(mean_images(), STAR, START, dark_variance_e2=NOISE_E**2)
    # The smoothness costs 1 %.
    assert distance(found.profile) < 0.02
    # Spots are cut at the windows' edges.
    np.testing.assert_allclose(found.flux_e, FLUX_E, rtol=5e-3)


def test_noise_adds_little_and_is_what_it_is_said_to_be() -> None:
    found = fit_sodium_profile(mean_images(FRAMES), STAR, START, dark_variance_e2=NOISE_E**2)
    assert distance(found.profile) < 0.06
    # Chi square: pixels less 36 fluxes and some 10 altitudes; 5 standard deviations.
    pixels = len(PLACES) * SIDE**2
    assert abs(found.chi_square - (pixels - 46)) < 5 * np.sqrt(2 * pixels)


def test_spots_are_centred_by_convention() -> None:
    tilted = np.array([0.3, -0.2])
    for slopes in (0.0, tilted):
        found = fit_sodium_profile(mean_images(slopes=slopes), STAR, START)
        away = float(STAR.defocus(ALTITUDES) @ found.profile.density)
        # In units of the inverse distance per metre: 10 m.
        assert abs(away) < 10.0 / 90e3**2
    assert distance(found.profile) < 0.02


def test_the_spot_is_found_with_the_profile() -> None:
    narrow = replace(STAR, spot=fs.PSF.analytic("gaussian", size=0.8, radius_px=6))
    wide, found = fit_spot(mean_images(FRAMES), narrow, START, dark_variance_e2=NOISE_E**2)
    assert wide.spot.fwhm_px[0, 0] == pytest.approx(STAR.spot.fwhm_px[0, 0], rel=0.01)
    assert distance(found.profile) < 0.06


def test_running_means_forget_slowly() -> None:
    rng = np.random.default_rng(3)
    frames, slopes = rng.normal(size=(12, 4, 5, 6)), rng.normal(size=(12, 4, 2))
    mean = MeanImages(frames[:2], slopes[:2], time_constant_frames=100.0)
    for i in range(2, 12, 5):
        mean = mean.updated(frames[i : i + 5], slopes[i : i + 5])
    np.testing.assert_allclose(mean.images_e, frames.mean(axis=0))
    np.testing.assert_allclose(mean.slopes_px, slopes.mean(axis=0))
    assert mean.frames == pytest.approx(12)
    # After many time constants, the weight of the newest frame is 1 - exp(-1 / 100).
    mean = replace(mean, frames=1e6).updated(mean.images_e + 1.0, mean.slopes_px)
    np.testing.assert_allclose(mean.images_e - frames.mean(axis=0), 1 - np.exp(-0.01))


def test_what_is_refused() -> None:
    images, slopes = np.ones((4, 5, 5)), np.zeros((4, 2))
    assert_each_refused(
        partial(MeanImages, images_e=images, slopes_px=slopes),
        images_e=[images[0], images * np.nan],
        slopes_px=[slopes[:3]],
        time_constant_frames=[0.0],
    )
    assert_each_refused(
        partial(MeanImages(images, slopes).updated, slopes_px=slopes), images_e=[images[:, 1:]]
    )
    mean = mean_images()
    few = MeanImages(mean.images_e[:3], mean.slopes_px[:3])
    for wrong in (few, replace(mean, images_e=0.0 * mean.images_e)):
        with refused("images_e"):
            fit_sodium_profile(wrong, STAR, START)
    assert_each_refused(partial(fit_sodium_profile, mean, STAR, START), dark_variance_e2=[-1.0, [1.0, 2.0]])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_images_without_spots_give_a_profile_or_a_refusal(scale: float) -> None:
    rng = np.random.default_rng(4)
    shape, slopes = (len(PLACES), SIDE, SIDE), np.zeros((len(PLACES), 2))
    for images in (rng.normal(0.1, 1.0, shape), np.eye(shape[0] * SIDE, SIDE).reshape(shape)):
        try:
            found = fit_sodium_profile(MeanImages(scale * images, slopes), STAR, START, dark_variance_e2=1.0)
        except fs.InputError:
            continue
        assert np.isfinite(found.profile.density).all()
        assert np.isfinite(found.flux_e).all()
