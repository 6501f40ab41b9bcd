import numpy as np
import pytest

from faintspot.slopes.simulate import Detector, subapertures
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.search_range import Images, SpotRange, spot_range

SHAPE, SPOTS = (12, 12), 600
ANYWHERE = 4.0  # px: as far as spots of this window can be told


def measured(flux_e: float, positions: np.ndarray, relative: np.ndarray | float = 1.0) -> SpotRange:
    """Return the range of spots at 3 e- of read noise; it knows the flux only up to a factor of 2."""
    rng = np.random.default_rng(3)
    camera, flux = Detector(read_noise_e=3.0), flux_e * relative * np.ones(len(positions))
    images, _ = subapertures(
        len(positions), shape=SHAPE, flux_e=flux, positions=positions, detector=camera, rng=rng
    )
    references = np.zeros_like(positions)
    return spot_range(
        Images(images.astype(np.float64), references, 2 * flux, 9.0, 1.0), PSF.analytic(radius_px=10)
    )


@pytest.mark.parametrize(
    ("flux_e", "true_px"), [(30.0, 0.0), (200.0, 0.5), (30.0, 1.0), (200.0, 2.0), (30.0, ANYWHERE)]
)
def test_noise_is_not_taken_for_motion(flux_e: float, true_px: float) -> None:
    positions = np.random.default_rng(8).uniform(-true_px, true_px, (SPOTS, 2))
    found = measured(flux_e, positions)
    assert found.is_measured
    assert found.quantile_px == pytest.approx(true_px, abs=0.4 + 0.1 * true_px)  # squares grow by 0.25 px
    assert found.flux_scale == pytest.approx(0.5, rel=0.12)


def test_an_offset_common_to_all_spots_counts_once() -> None:
    positions = np.random.default_rng(8).uniform(-0.3, 0.3, (SPOTS, 2)) + np.array([1.5, -1.0])
    assert measured(60.0, positions).quantile_px == pytest.approx(1.8, abs=0.3)


def test_dim_subapertures_are_as_near_as_bright_ones() -> None:
    flux = np.where(np.arange(SPOTS) % 4, 1.3, 0.1)
    assert measured(60.0, np.zeros((SPOTS, 2)), flux).quantile_px < 0.5


@pytest.mark.parametrize("true_px", [0.0, ANYWHERE])
def test_too_little_flux_is_told(true_px: float) -> None:
    positions = np.random.default_rng(8).uniform(-true_px, true_px, (SPOTS, 2))
    assert not measured(2.0, positions).is_measured
