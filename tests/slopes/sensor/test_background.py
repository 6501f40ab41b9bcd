"""Background below spots: of the frame where it is smooth, of the lenslet where a field stop ends it."""

import numpy as np
import pytest
from benchmarks.frames.backgrounds import ACROSS, KINDS, PIXELS, scene
from numpy.typing import NDArray
from tests.patience import mostly_slow

from faintspot.slopes.sensor.background import least_difference, lenslet_background, values_at, varies
from faintspot.slopes.sensor.detection.lenslets import find_lenslets
from faintspot.slopes.sensor.region import neighbour_vectors

SKY_E, FWHM_TO_STD = 40.0, 1 / 2.3548
BESIDE = neighbour_vectors("square", PIXELS, 0.0)


@pytest.mark.parametrize("kind", mostly_slow(1, KINDS))
@pytest.mark.parametrize(("fwhm_px", "flux_e", "most"), [(3.0, 600.0, 1.0), (5.5, 2000.0, 1.5)])
def test_background_of_lit_lenslets(kind: str, fwhm_px: float, flux_e: float, most: float) -> None:
    """To 1 of 40 e- (1.5 below wings) apart from a constant; a smooth map is off by 10 at edges.

    Spots that overlap leave a constant of up to a tenth of their background.
    """
    (spots, sky), rng = scene(kind, fwhm_px), np.random.default_rng(1)
    frame = flux_e * spots + SKY_E * sky + rng.normal(100.0, 1.0, sky.shape)
    middles = spots[PIXELS // 2 :: PIXELS, PIXELS // 2 :: PIXELS]
    rows, columns = np.nonzero(middles > 0.3 * middles.max())
    at = PIXELS * (columns + 1j * rows) + (1 + 1j) * (PIXELS - 1) / 2
    found = lenslet_background(frame, at, BESIDE, PIXELS, fwhm_px * FWHM_TO_STD)
    lit = np.zeros((ACROSS, ACROSS), bool)
    lit[rows, columns] = True
    error = (found - 100 - SKY_E * sky)[np.kron(lit, np.ones((PIXELS, PIXELS), bool))]
    assert error.std() < most
    assert abs(error.mean()) < 4.0


@pytest.mark.parametrize("kind", mostly_slow(1, ["edge", "even", "haze"]))
def test_sky_does_not_move_the_lattice(kind: str) -> None:
    """A tenth of a pixel: with a mean background, sky in lit lenslets makes the pitch larger by 0.03 px."""
    spots, sky = scene(kind, 3.0)
    rng = np.random.default_rng(1)
    grid = find_lenslets(600 * spots + SKY_E * sky + rng.normal(100.0, 2.0, sky.shape))
    assert len(grid.cells) == 116
    assert not grid.doubt
    assert grid.pitch_px == pytest.approx(PIXELS, abs=0.01)
    middles = np.floor(grid.spots / PIXELS) * PIXELS + (PIXELS - 1) / 2
    assert np.sqrt(np.mean((grid.spots - middles) ** 2)) < 0.1


SIDE, PITCH_PX, SPOT_PX, FLUX, NOISE = 200, 20.0, 1.5, 1000.0, 2.0
ROW, COLUMN = np.mgrid[:SIDE, :SIDE]
CENTRES = 10.0 + PITCH_PX * np.arange(9) + 10
SPOTS = np.stack(np.meshgrid(CENTRES, CENTRES), axis=-1).reshape(-1, 2)


def frame(background: NDArray[np.float64]) -> NDArray[np.float64]:
    peak = FLUX / (2 * np.pi * SPOT_PX**2)
    spots = sum(peak * np.exp(-0.5 * ((COLUMN - x) ** 2 + (ROW - y) ** 2) / SPOT_PX**2) for x, y in SPOTS)
    return np.asarray(spots + background + np.random.default_rng(1).normal(0, NOISE, (SIDE, SIDE)))


def reflection(peak: float) -> NDArray[np.float64]:
    return np.asarray(100 + peak * np.exp(-0.5 * ((COLUMN - 90) ** 2 + (ROW - 110) ** 2) / 25.0**2))


def background_of(image: NDArray[np.float64], spot_px: float = SPOT_PX) -> NDArray[np.float64]:
    around = neighbour_vectors("square", PITCH_PX, 0.0)
    return lenslet_background(image, SPOTS @ np.array([1, 1j]), around, PITCH_PX, spot_px)


def levels_of(image: NDArray[np.float64], spot_px: float = SPOT_PX) -> NDArray[np.float64]:
    return values_at(background_of(image, spot_px), SPOTS @ np.array([1, 1j]))


def test_background_below_the_spots() -> None:
    """Within a tenth of its peak, with a hot pixel and one to ignore."""
    truth = reflection(50.0)
    image = frame(truth)
    image[31, 31] += 1e5
    image[51, 51] = np.nan
    found = background_of(image)
    assert np.abs(found - truth)[10:-10, 10:-10].max() < 5.0


@pytest.mark.parametrize(("peak", "expected"), mostly_slow(1, [(0.0, False), (0.5, False), (50.0, True)]))
def test_variation_that_matters(peak: float, expected: bool) -> None:
    image = frame(reflection(peak))
    assert varies(levels_of(image), least_difference(image, FLUX, PITCH_PX, SPOT_PX)) == expected


def test_noise_is_no_variation() -> None:
    """Spots so faint that the error of the background is a tenth of their flux."""
    image = np.random.default_rng(2).normal(100, 50.0, (SIDE, SIDE))
    assert not varies(levels_of(image), least_difference(image, 300.0, PITCH_PX, SPOT_PX))


@pytest.mark.parametrize("width", mostly_slow(1, [0.255, 0.2]))
def test_wings_of_wide_spots_are_no_background(width: float) -> None:
    """A third of the peak between two spots, and none of it outside the array."""
    spot_px = width * PITCH_PX
    spots = sum(np.exp(-0.5 * ((COLUMN - x) ** 2 + (ROW - y) ** 2) / spot_px**2) for x, y in SPOTS)
    image = 170 * spots + np.random.default_rng(1).normal(30, 0.5, (SIDE, SIDE))
    levels, flux = levels_of(image, 1.1 * spot_px), 170 * 2 * np.pi * spot_px**2
    assert np.abs(levels - 30).max() < 0.05 * 170
    assert not varies(levels, least_difference(image, flux, PITCH_PX, spot_px))
