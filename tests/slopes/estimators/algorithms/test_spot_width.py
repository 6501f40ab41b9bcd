"""Width and flux of spots by their autocorrelation."""

import numpy as np
import pytest
from tests.refusals import refused

from faintspot.slopes.estimators.algorithms.centroid import like_most, seen_spots
from faintspot.slopes.simulate import Detector, subapertures


@pytest.mark.parametrize(
    ("flux_e", "read_noise_e", "n"), [(1e5, 0.1, 50), (30.0, 0.1, 500), (100.0, 3.0, 2000)]
)
def test_width_and_flux_wherever_the_spots_are(flux_e: float, read_noise_e: float, n: int) -> None:
    """FWHM 3 px, elongated by 1.5, pixel included: 3.07 and 4.55; to 8 % where single spots are lost."""
    images, _ = subapertures(
        n,
        shape=(20, 20),
        flux_e=flux_e,
        profile="gaussian",
        size=1.5,
        elongation=1.5,
        position_range_px=3.0,
        detector=Detector(read_noise_e),
        rng=np.random.default_rng(1),
    )
    for scale in (1e-4, 1.0, 1e4):
        found = seen_spots(scale * images + 7.0 * scale)
        assert found.fwhm_x_px == pytest.approx(4.55, rel=0.08)
        assert found.fwhm_y_px == pytest.approx(3.07, rel=0.08)
        assert found.flux == pytest.approx(scale * flux_e, rel=0.1)


def test_without_spots() -> None:
    with refused("images", "found none"):
        seen_spots(np.ones((5, 8, 8)))
    with refused("images", "4 x 4"):
        seen_spots(np.ones((5, 8, 3)))
    with refused("images"):
        seen_spots(np.full((5, 8, 8), np.nan))


@pytest.mark.parametrize("flux_e", [30.0, 500.0, 1e5])
def test_structures_are_unlike_most_spots(flux_e: float) -> None:
    """A bright gradient, a wide patch and a flare are left out, and almost no spot."""
    images, _ = subapertures(
        60,
        shape=(20, 20),
        flux_e=flux_e,
        profile="gaussian",
        size=1.5,
        position_range_px=3.0,
        detector=Detector(1.0),
        rng=np.random.default_rng(1),
    )
    row, column = np.mgrid[:20, :20]
    images[3] += 0.2 * flux_e * column
    images[17] += 0.2 * flux_e * np.exp(-0.5 * ((column - 9.0) ** 2 + (row - 11.0) ** 2) / 6.0**2)
    images[40, 5:9, 5:9] += flux_e
    kept = like_most(images[None])
    assert not kept[[3, 17, 40]].any()
    assert np.count_nonzero(kept) >= 55


@pytest.mark.parametrize("fwhm_px", [0.6, 1.0, 1.6])
def test_spots_sharper_than_nyquist(fwhm_px: float) -> None:
    """Width with the blur of the pixels, sqrt(12) of whose standard deviation are one of them."""
    images, _ = subapertures(
        300,
        shape=(12, 12),
        flux_e=5000.0,
        profile="gaussian",
        size=0.5 * fwhm_px,
        position_range_px=1.0,
        detector=Detector(3.0),
        rng=np.random.default_rng(1),
    )
    found = seen_spots(images)
    blurred = np.hypot(fwhm_px, 2.3548 / np.sqrt(12))
    assert found[:2] == pytest.approx([blurred, blurred], rel=0.04)
    assert found.flux == pytest.approx(5000, rel=0.05)
