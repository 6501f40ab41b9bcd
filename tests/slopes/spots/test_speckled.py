"""Speckled spots: without turbulence, against Kolmogorov theory, and inside simulated sub-apertures."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad
from tests.patience import mostly_slow
from tests.refusals import assert_each_refused, refused

from faintspot.slopes.estimators.centroid import centre_of_gravity
from faintspot.slopes.simulate import Detector, speckled_spots, spots, subapertures
from faintspot.slopes.spots import speckled
from faintspot.slopes.spots.shapes import structure_function


def kolmogorov(r: Any) -> Any:
    return 6.88 * np.asarray(r) ** (5 / 3)


def tilt_variance() -> float:
    """Variance of the mean gradient over a square of side d = r0, (lambda / d)^2, by its definition.

    The mean gradient is the difference of the means over two edges; products of differences are structure
    functions: the pairs across (distance sqrt(1 + t^2)) minus the pairs along one edge (distance t).
    """
    integral = quad(lambda t: 2 * (1 - t) * (kolmogorov(np.hypot(1, t)) - kolmogorov(t)), 0, 1)[0]
    return float(integral / (4 * np.pi**2))


def long_exposure(pixels: NDArray[np.float64], width: float, d_over_r0: float) -> NDArray[np.float64]:
    """Pixel-integrated long-exposure image, the Fourier transform of the long-exposure transfer function."""
    f = (np.arange(400) + 0.5) / 400 - 0.5
    f = 2 * f  # lags in d, from -1 to 1
    triangle = np.maximum(1 - np.abs(f), 0) * np.sinc(f / width)
    lag = np.hypot(f[:, None], f)
    transfer = triangle[:, None] * triangle * np.exp(-0.5 * kolmogorov(lag * d_over_r0))
    wave = np.exp(2j * np.pi * pixels[:, None] / width * f) * (f[1] - f[0])
    image: NDArray[np.float64] = (wave @ transfer @ wave.T).real / width**2
    return image


def half_width(cut: NDArray[np.float64]) -> float:
    """Full width at half maximum of a symmetric cut, px."""
    right = cut[len(cut) // 2 :]
    below = int(np.argmax(right < right[0] / 2))
    return float(2 * (below - 1 + (right[below - 1] - right[0] / 2) / (right[below - 1] - right[below])))


@pytest.mark.parametrize("size", mostly_slow(1, [0.25, 0.5, 1.0, 1.5, 3.0]))
def test_without_turbulence_the_spots_are_those_of_the_lenslet(size: float) -> None:
    images, truth = speckled_spots(
        40, d_over_r0=0.0, size=size, position_range_px=4.0, flux_e=30.0, rng=np.random.default_rng(1)
    )
    expected = spots(truth, size=size, flux_e=30.0)
    # Three or more samples a pixel: 1e-4 of the peak at most, measured.
    np.testing.assert_allclose(images, expected, rtol=0, atol=2e-4 * expected.max())


def natural_tilt(n: int, d_over_r0: float, size: float, seed: int) -> NDArray[np.float64]:
    """Displacements [px] by the mean gradients that `speckled_images` takes away."""
    modes = speckled._phase_modes(speckled._FEWEST_POINTS)
    strength = np.full(n, d_over_r0 ** (5 / 6))
    return speckled._draw(modes, strength, np.random.default_rng(seed))[1] * size / np.pi


def test_natural_tilt_has_the_variance_of_the_angle_of_arrival() -> None:
    n, d_over_r0, size = 12000, 2.0, 1.5
    truth = natural_tilt(n, d_over_r0, size, 3)
    expected = tilt_variance() * d_over_r0 ** (5 / 3) * (2 * size) ** 2
    # The constant is 0.163: a little less than the 0.17 to 0.18 of a least-squares tilt over a circle.
    assert 0.15 < tilt_variance() < 0.18
    # A variance from 12,000 draws: standard error 1.3 %, times 4; the grid's own error is below 0.5 %.
    np.testing.assert_allclose(truth.var(axis=0), expected, rtol=0.06)
    assert abs(np.mean(truth[:, 0] * truth[:, 1])) < 4.5 * expected / np.sqrt(n)


@pytest.mark.slow
@pytest.mark.parametrize("d_over_r0", [1.5, 4.0])
def test_long_exposure_is_kolmogorovs(d_over_r0: float) -> None:
    n, size, pixels = 2500, 1.5, np.linspace(-12.0, 12.0, 25)
    tilt, rng = natural_tilt(n, d_over_r0, size, 4), np.random.default_rng(4)
    images = speckled.speckled_images(tilt, d_over_r0=d_over_r0, size=size, shape=(25, 25), rng=rng)
    mean: NDArray[np.float64] = images.mean(axis=0)
    expected = long_exposure(pixels, 2 * size, d_over_r0)
    # Speckle: a pixel scatters by about its mean, 2 % for 2500 images at the peak, 5 standard errors; the
    # squares of constant phase (d / 24) send 1.5 % of the flux too far out.
    np.testing.assert_allclose(mean, expected, rtol=0, atol=0.1 * expected.max())
    found, theory = half_width(mean.mean(axis=0)), half_width(expected.mean(axis=0))
    assert abs(found / theory - 1) < 0.05
    # The textbook's 0.98 lambda / r0, to which the lenslet's own width adds a part.
    assert 1.0 < half_width(expected[12]) / (0.98 * d_over_r0 * 2 * size) < 1.0 + 0.5 / d_over_r0


def test_strehl_ratio_in_weak_turbulence() -> None:
    """1 - Strehl is the variance of the phase without its piston and mean gradient."""
    line = (np.arange(24) + 0.5) / 24 - 0.5
    y, x = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    piston_removed = 0.5 * kolmogorov(np.hypot(x[:, None] - x, y[:, None] - y)).mean()
    to_right, to_left = (np.hypot(x[:, None] - edge, y[:, None] - line) for edge in (0.5, -0.5))
    with_gradient = (0.5 * x[:, None] * (kolmogorov(to_left) - kolmogorov(to_right))).mean()
    gradient = tilt_variance() * 4 * np.pi**2
    variance = piston_removed + 2 * (gradient * np.mean(x**2) - 2 * with_gradient)
    d_over_r0, n, size = 0.4, 1500, 6.0
    known: dict[str, Any] = {"positions": np.zeros((n, 2)), "shape": (1, 1)}
    images, _ = speckled_spots(n, d_over_r0=d_over_r0, size=size, rng=np.random.default_rng(5), **known)
    strehl = images.mean() / spots([[0.0, 0.0]], size=size, shape=(1, 1))[0, 0, 0]
    # Next order: variance^2 / 2, 2 % of the loss; scatter of the loss about 60 %, 1.6 % of its mean.
    assert abs((1 - strehl) / (variance * d_over_r0 ** (5 / 3)) - 1) < 0.09


@pytest.mark.slow
def test_truth_is_the_centre_of_gravity_of_all_the_flux() -> None:
    images, truth = speckled_spots(
        60, d_over_r0=2.0, shape=(60, 56), position_range_px=2.0, rng=np.random.default_rng(6)
    )
    # Light outside 28 lambda / d (2 %) pulls by a few hundredths of a pixel; positions have a rms above 1.
    error = centre_of_gravity(images) - truth
    assert np.sqrt(np.mean(error**2)) < 0.06
    assert truth.std() > 1.0


def test_an_immense_outer_scale_is_kolmogorov_s() -> None:
    """But for 1.03 (2 pi r / L0)^(1/3) less."""
    r = np.array([0.02, 0.3, 1.4])
    np.testing.assert_allclose(structure_function(r, 1e5), kolmogorov(r), rtol=0.06)


def test_every_image_has_its_own_turbulence_and_size() -> None:
    images, truth = speckled_spots(
        3, d_over_r0=[0.0, 3.0, 0.0], size=[1.0, 1.0, 2.0], flux_e=[1.0, 1.0, 5.0], position_range_px=2.0
    )
    expected = spots(truth, size=[1.0, 1.0, 2.0], flux_e=[1.0, 1.0, 5.0])
    np.testing.assert_allclose(images[[0, 2]], expected[[0, 2]], rtol=0, atol=1e-3 * expected.max())
    assert np.max(np.abs(images[1] - expected[1])) > 0.1 * expected[1].max()


def test_the_same_seed_gives_the_same_images_however_many() -> None:
    few, _ = speckled_spots(5, d_over_r0=2.0, positions=np.zeros((5, 2)), rng=np.random.default_rng(9))
    many, _ = speckled_spots(400, d_over_r0=2.0, positions=np.zeros((400, 2)), rng=np.random.default_rng(9))
    # Matrix products of other sizes round differently.
    np.testing.assert_allclose(few, many[:5], rtol=0, atol=1e-6)


@pytest.mark.slow
@given(
    d_over_r0=st.floats(0, 10),
    size=st.floats(0.3, 4),
    shape=st.tuples(st.integers(1, 30), st.integers(1, 30)),
)
def test_flux_is_never_negative_nor_made(d_over_r0: float, size: float, shape: tuple[int, int]) -> None:
    images, truth = speckled_spots(4, d_over_r0=d_over_r0, size=size, shape=shape, flux_e=7.0)
    assert images.shape == (4, *shape)
    assert np.all(images >= 0)
    # The largest size of window in lambda / d here is 50, where repeated images add up to 1 %.
    assert np.all(images.sum(axis=(1, 2)) <= 7.0 * 1.02)
    assert np.all(np.isfinite(truth))


def test_subapertures_see_turbulence_and_keep_their_positions() -> None:
    quiet = Detector(0.0)
    still, truth = subapertures(300, flux_e=1e5, detector=quiet, rng=np.random.default_rng(10))
    speckled, same = subapertures(
        300, flux_e=1e5, d_over_r0=2.0, detector=quiet, rng=np.random.default_rng(10)
    )
    np.testing.assert_array_equal(truth, same)
    assert speckled.dtype == np.float32
    assert speckled.max(axis=(1, 2)).mean() < 0.8 * still.max(axis=(1, 2)).mean()
    # Turbulence of 2 r0 spreads 3 to 5 % of the flux beyond 16 pixels.
    flux = speckled.sum(axis=(1, 2)) / still.sum(axis=(1, 2))
    assert 0.9 < flux.mean() < 1.0


def test_no_turbulence_leaves_the_draws_of_subapertures_as_they_were() -> None:
    rng, other = np.random.default_rng(11), np.random.default_rng(11)
    for _ in range(2):
        plain, _ = subapertures(20, rng=rng)
        same, _ = subapertures(20, d_over_r0=0.0, rng=other)
        np.testing.assert_array_equal(plain, same)


def test_wrong_values_are_refused() -> None:
    assert_each_refused(
        partial(speckled_spots, 3, d_over_r0=1.0),
        d_over_r0=[-1.0, 11.0, [1.0, 2.0]],
        size=[0.01],
        positions=[[[0.0, 0.0]]],
        position_range_px=[-1.0],
        flux_e=[np.nan],
        rng=[np.random],
    )


def test_turbulence_needs_a_round_diffraction_spot() -> None:
    for shape in ({"profile": "gaussian"}, {"elongation": [1.0, 1.0, 2.0]}):
        options: dict[str, Any] = shape
        with refused("d_over_r0 = 1", "elongation 1"):
            subapertures(3, d_over_r0=1.0, **options)
