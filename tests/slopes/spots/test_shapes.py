"""Spots: flux, position and width against numerical integration and against their definitions."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad
from tests.refusals import assert_each_refused

from faintspot.slopes.estimators.centroid import centre_of_gravity
from faintspot.slopes.simulate import spots

# Closed forms are differences of numbers near 1: a few units of round-off.
ROUND_OFF = 1e-13
# Promised for rotated spots, as a fraction of the brightest pixel.
ROTATED_ACCURACY = 1e-4


def line(profile: str, width_px: float) -> Any:
    """Return the one-dimensional density of unit area; width: lambda / d, or the FWHM."""
    if profile == "diffraction":
        return lambda x: np.sinc(x / width_px) ** 2 / width_px
    sigma = width_px / np.sqrt(8 * np.log(2))
    return lambda x: np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


@pytest.mark.parametrize("profile", ["diffraction", "gaussian"])
@pytest.mark.parametrize("size", [0.5, 1.0, 2.5])
def test_each_pixel_equals_numerical_integration(profile: str, size: float) -> None:
    position = (0.83, -1.27)
    image = spots([position], shape=(5, 8), flux_e=300.0, profile=profile, size=size, elongation=1.7)[0]
    along = [
        quad(line(profile, 2 * size * 1.7), j - 4 - position[0], j - 3 - position[0], epsabs=1e-13)[0]
        for j in range(8)
    ]
    across = [
        quad(line(profile, 2 * size), i - 2.5 - position[1], i - 1.5 - position[1], epsabs=1e-13)[0]
        for i in range(5)
    ]
    # quad delivers 1e-13 of an axis fraction; 300 electrons.
    np.testing.assert_allclose(image, 300 * np.outer(across, along), rtol=0, atol=1e-10)


@given(
    x=st.floats(-2, 2),
    y=st.floats(-2, 2),
    size=st.floats(0.05, 1.2),
    flux=st.floats(0, 1e5),
    angle=st.floats(-360, 360),
)
def test_gaussian_flux_and_centroid(x: float, y: float, size: float, flux: float, angle: float) -> None:
    image = spots([[x, y]], shape=(24, 24), flux_e=flux, profile="gaussian", size=size, angle_deg=angle)
    # Sigma is at most 1.02 px and the edge 10 px away: less than 1e-20 is lost.
    assert image.sum() == pytest.approx(flux, rel=ROUND_OFF, abs=1e-300)
    if size > 1 and flux > 1e-3:
        # Pixels alias the centroid of narrow spots: exp(-2 (pi * 0.849)^2) / pi = 2e-7 px at size 1.
        np.testing.assert_allclose(centre_of_gravity(image), [[x, y]], atol=1e-6)


@pytest.mark.parametrize("profile", ["diffraction", "gaussian"])
def test_elongation_and_rotation(profile: str) -> None:
    def image(x: float, y: float, angle: float) -> NDArray[np.float64]:
        images = spots([[x, y]], profile=profile, elongation=2.5, angle_deg=angle)
        return images.reshape(16, 16)

    # Turning by 90 degrees swaps rows and columns, by 180 changes nothing, a mirror reverses the angle.
    np.testing.assert_allclose(image(0.4, -0.9, 90), image(-0.9, 0.4, 0).T, atol=ROUND_OFF)
    np.testing.assert_allclose(image(0.4, -0.9, 180), image(0.4, -0.9, 0), atol=ROUND_OFF)
    np.testing.assert_allclose(image(0.4, -0.9, 270), image(0.4, -0.9, 90), atol=ROUND_OFF)
    np.testing.assert_allclose(image(0.4, -0.9, -90), image(0.4, -0.9, 90), atol=ROUND_OFF)
    np.testing.assert_allclose(image(0.4, -0.9, 215), image(0.4, -0.9, 35), atol=ROUND_OFF)
    np.testing.assert_allclose(image(0.4, -0.9, 35), image(0.4, 0.9, -35)[::-1], atol=ROUND_OFF)
    np.testing.assert_allclose(image(0.4, -0.9, 35), image(-0.9, 0.4, 55).T, atol=ROUND_OFF)
    # At 30 degrees from x towards y light lies where x and y have the same sign.
    x = y = np.arange(16) - 7.5
    assert (image(0, 0, 30) * np.outer(y, x)).sum() > 0
    second_x = (image(0, 0, 0) * x**2).sum()
    second_y = (image(0, 0, 0) * y[:, None] ** 2).sum()
    assert second_x > second_y


@pytest.mark.parametrize("profile", ["diffraction", "gaussian"])
@pytest.mark.parametrize("size", [0.05, 0.25, 0.6, 1.0, 2.1])
@pytest.mark.parametrize("angle", [0.0, 90.0, 180.0])
def test_rotated_path_equals_closed_form(profile: str, size: float, angle: float) -> None:
    # An angle past the tolerance for a right angle, too small to matter: the numerical path must agree.
    positions = [[0.1, -0.7], [1.3, 0.49], [0.5, 0.5]]
    options: dict[str, Any] = {"shape": (7, 6), "profile": profile, "size": size, "elongation": 1.3}
    exact = spots(positions, angle_deg=angle, **options)
    numerical = spots(positions, angle_deg=angle + 1e-8, **options)
    limit = ROTATED_ACCURACY * exact.max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(numerical - exact) < limit)
    assert not np.array_equal(numerical, exact)


@pytest.mark.parametrize("profile", ["diffraction", "gaussian"])
@pytest.mark.parametrize(("size", "angle"), [(0.5, 45.0), (1.0, 45.0), (1.0, 20.0), (2.0, 70.0)])
def test_rotated_spots_against_a_dense_midpoint_sum(profile: str, size: float, angle: float) -> None:
    image = spots([[0.3, -0.4]], shape=(6, 6), profile=profile, size=size, elongation=1.2, angle_deg=angle)[0]
    fine = 40
    grid = (np.arange(6 * fine) + 0.5) / fine - 3
    dx, dy = grid[None, :] - 0.3, grid[:, None] + 0.4
    cosine, sine = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    along = line(profile, 2 * size * 1.2)(cosine * dx + sine * dy)
    across = line(profile, 2 * size)(cosine * dy - sine * dx)
    dense = (along * across).reshape(6, fine, 6, fine).mean(axis=(1, 3))
    # The midpoint rule at 1/40 px adds (1/40)^2 / 24 * curvature, up to 2e-4 of the peak at size 0.5.
    tolerance = ROTATED_ACCURACY + (1 / fine) ** 2 / 24 * 2 * (np.pi / size) ** 2 / 2
    np.testing.assert_allclose(image, dense, rtol=0, atol=tolerance * dense.max())


def test_parameters_per_spot_equal_spots_one_by_one() -> None:
    rng = np.random.default_rng(3)
    n = 300  # several blocks of the loop inside
    positions = rng.uniform(-2, 2, (n, 2))
    flux, size = rng.uniform(0, 90, n), rng.uniform(0.8, 2, n)
    elongation, angle = rng.uniform(1, 3, n), rng.choice([0.0, 90.0, 33.0, -70.0], n)
    size[0] = 0.8  # the smallest spot sets the samples per pixel
    together = spots(positions, flux_e=flux, size=size, elongation=elongation, angle_deg=angle)
    for i in (0, 1, 127, 128, 129, 299):
        alone = spots(
            positions[i : i + 1], flux_e=flux[i], size=size[i], elongation=elongation[i], angle_deg=angle[i]
        )[0]
        np.testing.assert_allclose(together[i], alone, rtol=0, atol=ROTATED_ACCURACY * alone.max())
    assert together.min() >= 0
    assert together.shape == (n, 16, 16)
    assert together.dtype == np.float64


def test_bad_inputs_are_named_in_one_line() -> None:
    assert_each_refused(
        partial(spots, positions=[[0, 0]]),
        flux_e=[-1, np.nan, [1, 2]],
        positions=[[[0, np.nan]], [0, 0], [[0, 0, 0]], np.zeros((0, 2))],
        profile=["airy", ["gaussian"]],
        size=[0],
        elongation=[0.5],
        angle_deg=[np.inf],
        shape=[(0, 16), np.array(16), (16.5, 16)],
    )
