"""Centre of gravity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack
from faintspot.slopes.kernels.compilation.host import lanes_for
from faintspot.slopes.kernels.gravity.stacks import centroid_stack
from faintspot.slopes.kernels.parallel import run_groups


def centre_of_gravity(images: ArrayLike) -> NDArray[Any]:
    """Return the centre of gravity of each image.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images; computed in float32 if they are float32 or float16, otherwise in float64.

    Returns
    -------
    (..., 2) array
        x (along columns) and y (along rows) in pixels from the image centre: pixel i of n is at
        ``i - (n - 1) / 2``. The result is (0, 0), never NaN, if the sum of the image is not positive or too
        small relative to its values to define a position.

    Raises
    ------
    InputError
        If images are not real, finite and at least two-dimensional.

    Examples
    --------
    >>> import faintspot as fs
    >>> print(fs.centre_of_gravity([[0.0, 0.0, 0.0], [0.0, 3.0, 1.0], [0.0, 0.0, 0.0]]))
    [0.25 0.  ]
    """
    stack = image_stack("images", images)
    ny, nx = stack.shape[-2:]
    # The kernel is compiled for arrays of one kind, not once more for those that are read-only.
    flat = np.require(_scaled_up(stack.reshape(-1, ny * nx)), requirements="W")
    positions = np.empty((len(flat), 2), stack.dtype)
    lanes = lanes_for(flat.dtype)

    def job(start: int, stop: int, scratch: tuple[object, ...]) -> None:
        centroid_stack(lanes, flat, ny, nx, start, stop, scratch, positions)

    run_groups(job, -(-len(flat) // lanes.width), lanes, (ny, nx))
    positions[~np.isfinite(positions).all(axis=1)] = 0.0
    return positions.reshape(*stack.shape[:-2], 2)


def _scaled_up(flat: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return images (n, pixels) in which those with tiny values are multiplied by a power of two.

    The kernel multiplies by the reciprocal of a sum, which overflows if the sum is subnormal.
    """
    limits = np.finfo(flat.dtype)
    largest = np.abs(flat).max(axis=1)
    tiny = (largest > 0) & (largest < limits.tiny / limits.eps)
    if not tiny.any():
        return flat
    # A subnormal number keeps all its digits.
    power = -int(np.log2(limits.tiny)) // 2 + int(limits.nmant)
    scaled = flat.copy()
    scaled[tiny] *= flat.dtype.type(2.0) ** power
    return scaled
