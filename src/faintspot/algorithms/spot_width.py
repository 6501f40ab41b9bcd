"""How wide and bright spots are, from images in which they may be too faint to be seen one by one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack
from faintspot.base.errors import InputError

_NARROWEST_PX, _WIDEST = 0.5, 0.75  # full width at half maximum; the latter of the window's side
_AREA_OF_SQUARED_FWHM = np.pi / (2 * np.log(2))  # noise-equivalent area of a Gaussian spot


class SeenSpots(NamedTuple):
    """Full width at half maximum (px, pixels' blur included) and rms flux of spots, in the images' unit."""

    fwhm_x_px: float
    fwhm_y_px: float
    flux: float


def seen_spots(images: ArrayLike) -> SeenSpots:
    """Measure the width and the flux of spots wherever they are in their images.

    The mean autocorrelation of the images does not depend on the spots' positions. Noise adds to it only at
    lag 0; that value is extrapolated as of a Gaussian from lags 1 and 2. The lag at which half of it is left
    is 1 / sqrt(2) of the full width at half maximum of a Gaussian spot. The flux is that of the same spot.

    Parameters
    ----------
    images : (..., ny, nx) array
        In any unit, of spots of one width; hundreds where they are lost in the noise.

    Returns
    -------
    SeenSpots

    Raises
    ------
    InputError
        When the images are not finite, smaller than 4 x 4, or show no spots.
    """
    stack: NDArray[np.float64] = image_stack("images", images).astype(np.float64)
    if min(stack.shape[-2:]) < 4:
        raise InputError(f"images: expected at least 4 x 4 pixels, got shape {stack.shape}")
    stack = stack - np.median(stack[..., [0, -1], :])
    stack = stack.reshape(-1, *stack.shape[-2:])
    (x, power_x), (y, power_y) = _along(stack), _along(stack.swapaxes(1, 2))
    flux = np.sqrt(0.5 * (power_x + power_y) * _AREA_OF_SQUARED_FWHM * x * y)
    return SeenSpots(x, y, float(flux))


def _along(images: NDArray[np.float64]) -> tuple[float, float]:
    """Return the width along the last axis, and the mean sum of squares of a spot without noise."""
    side = images.shape[-1]
    correlation = np.array([np.vdot(images[..., : side - lag], images[..., lag:]) for lag in range(side)])
    width = 0.0
    if correlation[1] > correlation[2] > 0:
        correlation[0] = correlation[1] * (correlation[1] / correlation[2]) ** (1 / 3)
        relative = correlation / correlation[0]
        beyond = int(np.argmax(relative < 0.5))
        if beyond > 0:
            before, after = np.log(relative[beyond - 1]), np.log(max(relative[beyond], 1e-9))
            width = float(np.sqrt(2.0) * (beyond - 1 + (before - np.log(0.5)) / (before - after)))
    if not _NARROWEST_PX < width < _WIDEST * side:
        raise InputError("images: expected spots whose width can be measured, found none")
    return width, float(correlation[0]) / len(images)
