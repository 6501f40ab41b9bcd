"""Gains of even and odd rows and columns are seen in wide spots, and sharp ones are not taken for them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.slopes.camera.frame_checks import mosaic_contrast

SIDE = 160
ROW, COLUMN = np.mgrid[:SIDE, :SIDE]


def contrast(width_px: float, pitch_px: float, gains: tuple[float, float, float, float]) -> float:
    centres = 20.0 + pitch_px * np.arange(6)
    spots: NDArray[np.float64] = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    image = sum(500 * np.exp(-0.5 * ((COLUMN - x) ** 2 + (ROW - y) ** 2) / width_px**2) for x, y in spots)
    image = image * np.tile(np.reshape(gains, (2, 2)), (SIDE // 2, SIDE // 2))
    image = image + np.random.default_rng(1).normal(100, 3, image.shape)
    image[40, 40] = np.nan
    return mosaic_contrast(image, spots, pitch_px, width_px)


@pytest.mark.parametrize("pitch_px", [20.0, 20.3])
@pytest.mark.parametrize("width_px", [1.2, 2.0, 3.0])
def test_the_contrast_is_that_of_the_gains(width_px: float, pitch_px: float) -> None:
    assert contrast(width_px, pitch_px, (0.6, 1.0, 1.0, 0.4)) == pytest.approx(2.5, rel=0.35)
    assert contrast(width_px, pitch_px, (1.0, 1.0, 1.0, 1.0)) == 1.0


@pytest.mark.parametrize("width_px", [0.5, 0.8, 1.0, 1.1])
def test_sharp_spots_at_the_same_place_of_their_pixels(width_px: float) -> None:
    assert contrast(width_px, 20.0, (1.0, 1.0, 1.0, 1.0)) == 1.0
