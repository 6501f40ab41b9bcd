"""Median of nine pixels, as `faintspot.study.arms.median_of_nine`, which says how."""

from __future__ import annotations

from typing import Any

from faintspot.cuda.compiling import device
from faintspot.cuda.strips import Strips


@device
def sorted_three(a: Any, b: Any, c: Any) -> Any:
    """The smallest, the middle and the largest."""
    low, high = min(a, b), max(a, b)
    return min(low, c), max(low, min(high, c)), max(high, c)


def make_median(strips: Strips) -> Any:
    """Return the function that writes the medians of a thread's pixels; edges continue outwards."""
    rows, ny, nx = strips.rows, strips.ny, strips.nx

    @device
    def median(image: Any, top: Any, column: Any, present: Any, medians: Any) -> None:
        """`image`: (ny, nx); `top`, `column`: of the thread's first pixel."""
        left, right = max(column - 1, 0), min(column + 1, nx - 1)
        for r in range(rows):
            if r < present:
                y = top + r
                above, below = max(y - 1, 0), min(y + 1, ny - 1)
                a, b, c = sorted_three(image[above, left], image[y, left], image[below, left])
                d, e, f = sorted_three(image[above, column], image[y, column], image[below, column])
                g, h, i = sorted_three(image[above, right], image[y, right], image[below, right])
                small, large = max(a, max(d, g)), min(c, min(f, i))
                centre = sorted_three(b, e, h)
                medians[r] = sorted_three(small, centre[1], large)[1]

    return median
