"""Images of spots and their derivatives in the position."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEP_PX = 0.01
"""Step of the differences for a PSF: a small part of a pixel, far above the rounding of the images."""


def images_with_derivatives(
    render: Callable[[Floats], Floats], positions: Floats, step_px: float = STEP_PX
) -> tuple[Floats, Floats, Floats]:
    """Return images and their derivatives along x and y by four-point differences, accurate to 1e-7.

    Parameters
    ----------
    render : callable
        Returns images (n, ny, nx) of spots at positions (n, 2).
    positions : (n, 2) array
    step_px : float
        Step of the differences.

    Returns
    -------
    images, along_x, along_y : (n, ny, nx) array
    """

    def derivative(step: Floats) -> Floats:
        near, far = (render(positions + k * step) - render(positions - k * step) for k in (1, 2))
        return (8 * near - far) / (12 * step_px)

    along_x, along_y = (derivative(step) for step in step_px * np.eye(2))
    return render(positions), along_x, along_y
