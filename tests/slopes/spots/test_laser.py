"""Spots of laser guide stars: closed formulas, their images, and those of OOPAO and SPECULA."""

import importlib
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import assert_each_refused, refused

import faintspot as fs

ARCSEC = np.pi / 180 / 3600
PLACES = np.array([[0.0, 0.0], [3.8, 0.2], [-2.6, 3.0], [-4.5, 0.0]])
LAUNCH = np.array([-4.5, 0.0])
SPOT = fs.PSF.analytic("gaussian", size=1.0, radius_px=6)
PROFILE = fs.SodiumProfile.peaks([86e3, 95e3], [5e3, 3e3], [0.6, 0.4])


def star(**changes: Any) -> fs.LaserGuideStar:
    known: dict[str, Any] = {"pixel_arcsec": 0.5, "spot": SPOT, "site_altitude_m": 2600.0}
    return fs.LaserGuideStar(PLACES, LAUNCH, **{**known, **changes})


def moments(images: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre of gravity (n, 2) and covariance (n, 2, 2) of images."""
    v, u = (np.arange(side) - (side - 1) / 2 for side in images.shape[1:])
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    flat = images.reshape(len(images), -1)
    flat = flat / flat.sum(axis=1, keepdims=True)
    mean = flat @ places
    away = places - mean[:, None]
    return mean, np.einsum("np,npi,npj->nij", flat, away, away)


@pytest.mark.parametrize("zenith_deg", [0.0, 40.0])
def test_elongation_is_baseline_times_depth_over_squared_height(zenith_deg: float) -> None:
    profile = fs.SodiumProfile.gaussian(90e3, 4e3)
    found = star(zenith_distance_deg=zenith_deg).elongation_px(profile)
    depth = profile.std_m * 2.3548 * np.cos(np.deg2rad(zenith_deg)) / (90e3 - 2600.0) ** 2
    # 1 / d is linear to (std / height)^2.
    np.testing.assert_allclose(found, (PLACES - LAUNCH) * depth / ARCSEC / 0.5, rtol=1e-3, atol=1e-12)


def test_an_image_by_adding_spots_one_by_one() -> None:
    sky = star(zenith_distance_deg=30.0, range_gate_m=[84e3, 97e3])
    altitudes = np.linspace(70e3, 105e3, 4001)
    finest = PROFILE.at(altitudes)
    inside = (altitudes >= 84e3) & (altitudes <= 97e3)
    each = SPOT.images(sky.offsets_px(altitudes)[1] + [0.7, -0.4], (10, 12))
    expected = np.einsum("kyx,k->yx", each, finest.density * inside) * (altitudes[1] - altitudes[0])
    where = np.zeros((4, 2))
    where[1] = 0.7, -0.4
    found = sky.images(PROFILE.at(np.linspace(70e3, 105e3, 401)), (10, 12), where)[1]
    np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())


def test_responses_images_and_psf_agree() -> None:
    sky = star()
    positions = np.array([[0.3, -0.8], [1.0, 0.2], [0.0, 0.0], [-0.5, 0.5]])
    images = sky.images(PROFILE, (10, 9), positions)
    responses = sky.responses(PROFILE.altitudes_m, (10, 9), positions)
    np.testing.assert_allclose(responses @ PROFILE.density, images)
    made = sky.psf(PROFILE).images(positions, (10, 9), which=np.arange(4))
    # Cubic splines between nodes a quarter of a pixel apart.
    np.testing.assert_allclose(made, images, atol=5e-4 * images.max())


def test_a_launch_within_a_subaperture_leaves_its_spot_round() -> None:
    images = star().images(PROFILE, (12, 12))
    np.testing.assert_allclose(images[3], SPOT.images([[0.0, 0.0]], (12, 12))[0], atol=1e-9)


def test_a_mean_altitude_off_focus_is_a_displacement_along_the_elongation() -> None:
    higher = fs.SodiumProfile(PROFILE.altitudes_m + 1e3, PROFILE.density)
    sky = star()
    moved = moments(sky.images(higher, (44, 44)))[0] - moments(sky.images(PROFILE, (44, 44)))[0]
    along = sky.elongation_px(PROFILE)
    # The baseline times the change of the distance over its square.
    expected = (PLACES - LAUNCH) * 1e3 / (PROFILE.mean_m - 2600.0) ** 2 / ARCSEC / 0.5
    np.testing.assert_allclose(moved, expected, rtol=0.02, atol=1e-3)
    np.testing.assert_allclose(moved[:, 0] * along[:, 1], moved[:, 1] * along[:, 0], atol=1e-3)


def test_impossible_stars_are_refused() -> None:
    places: dict[str, Any] = {"subapertures_m": PLACES, "launch_m": LAUNCH}
    assert_each_refused(
        partial(fs.LaserGuideStar, **places, pixel_arcsec=0.5, spot=SPOT, site_altitude_m=2600.0),
        subapertures_m=[[1.0, 2.0]],
        launch_m=[[1.0, 2.0, 3.0]],
        pixel_arcsec=[0.0],
        zenith_distance_deg=[90.0],
        site_altitude_m=[np.nan],
        focus_altitude_m=[2000.0],
        spot=[None],
        range_gate_m=[[95e3, 85e3]],
    )
    below = fs.SodiumProfile([0.0, 90e3], [0.0, 1.0])
    assert_each_refused(partial(star().images, PROFILE), positions=[np.zeros((3, 2))])
    with refused("altitudes_m"):
        star().images(below)
    with refused("psf.samples"):  # no light comes through the gate
        star(range_gate_m=[10e3, 20e3]).psf(PROFILE)


# Other tools -----------------------------------------------------------------------------------------

SIDE, FINE_ARCSEC = 120, 0.05
LAYERS = np.linspace(80e3, 100e3, 41)
NARROW = fs.SodiumProfile(LAYERS, np.exp(-0.5 * ((LAYERS - 90e3) / 3e3) ** 2))


def grid(launch: list[float], fwhm_px: float, pixel_arcsec: float) -> fs.LaserGuideStar:
    """5 x 5 sub-apertures whose centres reach the edges of a telescope of 8 m, as in both tools."""
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 5), np.linspace(-4.0, 4.0, 5))
    spot = fs.PSF.analytic("gaussian", size=fwhm_px / 2, radius_px=80)
    return fs.LaserGuideStar(np.stack([x.ravel(), y.ravel()], axis=1), launch, pixel_arcsec, spot)


def same_kernels(theirs: NDArray[np.float64], sky: fs.LaserGuideStar, profile: fs.SodiumProfile) -> None:
    """Compare kernels that are ordered by x, then y."""
    theirs = theirs.reshape(5, 5, SIDE, SIDE).swapaxes(0, 1).reshape(25, SIDE, SIDE)
    ours = sky.images(profile, (SIDE, SIDE))
    (_, theirs_moments), (_, moments_) = moments(theirs), moments(ours)
    values, vectors = np.linalg.eigh(theirs_moments)
    own_values, own_vectors = np.linalg.eigh(moments_)
    # Lengths within 2 %, directions within 2 % of a radian where spots are long.
    length, own = (np.sqrt(each[:, 1] - each[:, 0]) for each in (values, own_values))
    long = np.hypot(*sky.elongation_px(profile).T) > 10.0
    np.testing.assert_allclose(length[long], own[long], rtol=0.02)
    cosine = np.abs((vectors[:, :, 1] * own_vectors[:, :, 1]).sum(axis=1))
    assert np.all(cosine[long] > np.cos(0.02))
    # SPECULA's beam has the same width in metres at all altitudes, ours the same angle: 2.6 % rms.
    theirs, ours = (each / each.sum(axis=(1, 2), keepdims=True) for each in (theirs, ours))
    away = np.square(theirs - ours).mean(axis=(1, 2)) / np.square(ours).mean(axis=(1, 2))
    assert np.sqrt(away.max()) < 0.03


@pytest.mark.slow
def test_kernels_are_those_of_specula() -> None:
    specula = pytest.importorskip("specula")
    specula.init(-1, precision=1)  # before any other import of it
    kernels = importlib.import_module("specula.data_objects.convolution_kernel")
    field = FINE_ARCSEC * (SIDE - 1) / SIDE  # samples reach from edge to edge of the field
    layers = LAYERS - 90e3, NARROW.density
    theirs = kernels.lgs_map_sh(5, 8.0, [5.0, 1.0, 0.0], 90e3, *layers, 1.2, field, SIDE, overs=1)
    # Such a beam is brighter, the nearer it is.
    nearer = fs.SodiumProfile(LAYERS, NARROW.density / LAYERS**2)
    same_kernels(np.asarray(theirs, np.float64), grid([5.0, 1.0], 1.2 / FINE_ARCSEC, FINE_ARCSEC), nearer)
