"""Background between spots: a known one comes back, and only one that matters is told."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.slopes.camera.frame_checks import smooth_background, varies

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


def test_background_below_the_spots() -> None:
    """Within a tenth of its peak, with a hot pixel and one to ignore."""
    truth = reflection(50.0)
    image = frame(truth)
    image[31, 31] += 1e5
    image[51, 51] = np.nan
    found = smooth_background(image, SPOTS, PITCH_PX, SPOT_PX)
    assert np.abs(found - truth)[10:-10, 10:-10].max() < 5.0


@pytest.mark.parametrize(("peak", "expected"), [(0.0, False), (0.5, False), (50.0, True)])
def test_variation_that_matters(peak: float, expected: bool) -> None:
    image = frame(reflection(peak))
    background = smooth_background(image, SPOTS, PITCH_PX, SPOT_PX)
    column, row = SPOTS.astype(int).T
    assert varies(image, background[row, column], FLUX, PITCH_PX, SPOT_PX) == expected


def test_noise_is_no_variation() -> None:
    """Spots so faint that the error of the background is a tenth of their flux."""
    image = np.random.default_rng(2).normal(100, 50.0, (SIDE, SIDE))
    background = smooth_background(image, SPOTS, PITCH_PX, SPOT_PX)
    column, row = SPOTS.astype(int).T
    assert not varies(image, background[row, column], 300.0, PITCH_PX, SPOT_PX)


@pytest.mark.parametrize("width", [0.2, 0.255])
def test_wings_of_wide_spots_are_no_background(width: float) -> None:
    """A third of the peak between two spots, and none of it outside the array."""
    spot_px = width * PITCH_PX
    spots = sum(np.exp(-0.5 * ((COLUMN - x) ** 2 + (ROW - y) ** 2) / spot_px**2) for x, y in SPOTS)
    image = 170 * spots + np.random.default_rng(1).normal(30, 0.5, (SIDE, SIDE))
    background = smooth_background(image, SPOTS, PITCH_PX, 1.1 * spot_px)
    column, row = SPOTS.astype(int).T
    assert np.abs(background[row, column] - 30).max() < 0.05 * 170
    assert not varies(image, background[row, column], 170 * 2 * np.pi * spot_px**2, PITCH_PX, spot_px)
