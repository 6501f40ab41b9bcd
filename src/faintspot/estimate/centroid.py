"""Centre of gravity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import image_stack
from faintspot.kernels.host import lanes_for
from faintspot.kernels.parallel import run_groups
from faintspot.kernels.stacks import centroid_stack


def centre_of_gravity(images: ArrayLike) -> NDArray[Any]:
    """Return the centre of gravity of each image.

    Parameters
    ----------
    images : (..., ny, nx) array
        Computed in float32 when float32 (or float16), else in float64.

    Returns
    -------
    (..., 2) array
        x (along columns) and y (along rows) in pixels from the image's centre: pixel i of n is at
        ``i - (n - 1) / 2``. An image whose sum is not positive gives (0, 0), never NaN.

    Raises
    ------
    InputError
        For images that are not real, finite and at least two-dimensional.
    """
    stack = image_stack("images", images)
    ny, nx = stack.shape[-2:]
    flat = stack.reshape(-1, ny * nx)
    positions = np.empty((len(flat), 2), stack.dtype)
    lanes = lanes_for(flat.dtype)

    def job(start: int, stop: int, scratch: tuple[Any, ...]) -> None:
        centroid_stack(lanes, flat, ny, nx, start, stop, scratch, positions)

    run_groups(job, -(-len(flat) // lanes.width), lanes, (ny, nx))
    return positions.reshape(*stack.shape[:-2], 2)
