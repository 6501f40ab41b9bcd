"""Brightest-pixel background subtraction."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.slopes.kernels.compilation.host import lanes_for
from faintspot.slopes.kernels.gravity.stacks import subtract_stack
from faintspot.slopes.kernels.parallel import run_groups

RULES = ("subtract_next", "threshold", "subtract_kth")


def most_kept(pixels: int, rule: str) -> int:
    """Return the largest number of pixels that can be kept; "subtract_next" needs one more to subtract."""
    return pixels - 1 if rule == "subtract_next" else pixels


def threshold_rank(keep: NDArray[np.int64], rule: str) -> NDArray[np.int64]:
    """Return the rank (1 = largest) of the pixel whose value is the threshold."""
    return keep + 1 if rule == "subtract_next" else keep


def brightest_pixels(images: ArrayLike, keep: ArrayLike, *, rule: str = "subtract_next") -> NDArray[Any]:
    """Subtract the background from the `keep` brightest pixels of each image and set the others to zero.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images; computed in float32 if they are float32 or float16, otherwise in float64.
    keep : int or array of int
        Number of pixels k to keep, 1 to ny * nx (one less for "subtract_next"); scalar or broadcastable to
        the leading shape.
    rule : {"subtract_next", "threshold", "subtract_kth"}
        With t the threshold of image g:

        - "subtract_next" [1]_: t is the (k+1)-th largest value, the result max(g - t, 0). Exactly k pixels
          remain, unless some of them equal t; these become zero, too.
        - "threshold": t is the k-th largest value; pixels below t become zero, the others are unchanged. All
          pixels equal to t remain, so that there may be more than k.
        - "subtract_kth": t is the k-th largest value, the result max(g - t, 0); the k-th pixel becomes zero.

    Returns
    -------
    (..., ny, nx) array

    Raises
    ------
    InputError
        If images are not real, finite and at least two-dimensional, `keep` is out of range or its shape does
        not broadcast, or the rule is unknown.

    References
    ----------
    .. [1] Basden, A. G., Myers, R. M. & Gendron, E., 2012, MNRAS 419, 1628, and Basden et al. 2015,
       arXiv:1503.06043.

    Examples
    --------
    >>> import faintspot as fs
    >>> print(fs.brightest_pixels([[1.0, 2.0, 1.0], [2.0, 9.0, 6.0], [1.0, 3.0, 1.0]], 3))
    [[0. 0. 0.]
     [0. 7. 4.]
     [0. 1. 0.]]
    """
    stack = image_stack("images", images)
    one_of("rule", rule, RULES)
    leading, (ny, nx) = stack.shape[:-2], stack.shape[-2:]
    if ny * nx < 2:
        raise InputError(f"images: expected at least 2 pixels, got {ny} x {nx}")
    count = numbers_between(
        f"keep ({ny} x {nx} pixels, rule {rule!r})", keep, 1, most_kept(ny * nx, rule), integer=True
    )
    try:
        count = np.broadcast_to(count, leading)
    except ValueError:
        raise InputError(f"keep: shape {count.shape} does not broadcast to {leading}") from None

    # The kernel is compiled for arrays of one kind, not once more for those that are read-only.
    flat = np.require(stack.reshape(-1, ny * nx), requirements="W")
    rank = np.require(threshold_rank(count.reshape(-1), rule), requirements=["C", "W"])
    result = np.empty_like(flat)
    lanes = lanes_for(flat.dtype)
    subtract = 0.0 if rule == "threshold" else 1.0

    def job(start: int, stop: int, scratch: tuple[object, ...]) -> None:
        subtract_stack(lanes, flat, rank, subtract, start, stop, scratch, result)

    run_groups(job, -(-len(flat) // lanes.width), lanes, (ny, nx))
    return result.reshape(stack.shape)
