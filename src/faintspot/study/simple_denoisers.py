"""Ways to measure that only studies compare: objects like those of `faintspot.estimators`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.estimate.brightest import RULES
from faintspot.estimators.base import Style
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.gravity import KeepingBrightest
from faintspot.options import option

Images = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True)
class BrightestAsTheyAre(BrightestPixels):
    """All but the brightest pixels are zeroed; those stay as they are."""

    rule: Any = option("threshold", "As of `KeepingBrightest`.", choices=RULES)

    name = "threshold"
    label = "brightest pixels, rule “threshold”"
    style = Style("#0072B2", "--", "v")


@dataclass(frozen=True, eq=False, kw_only=True)
class MedianFiltered(KeepingBrightest):
    """The median of 3 x 3 pixels, then the brightest of them."""

    name = "median"
    label = "3 × 3 median filter"
    style = Style("#56B4E9", "-", "<")
    automatic_method = BrightestPixels.automatic_method

    def denoised(self, images: Images) -> Images:
        """See `KeepingBrightest`."""
        return median_of_nine(images)


def median_of_nine(images: Images) -> Images:
    """Return the median of each pixel and its eight neighbours; pixels at the edge continue outwards.

    The median of nine numbers in three sorted columns is the median of the largest of the small ones, the
    median of the middle ones and the smallest of the large ones.
    """
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)), mode="edge")
    low, middle, high = _sorted_three(padded[:, :-2], padded[:, 1:-1], padded[:, 2:])
    small = np.maximum(np.maximum(low[..., :-2], low[..., 1:-1]), low[..., 2:])
    centre = _sorted_three(middle[..., :-2], middle[..., 1:-1], middle[..., 2:])[1]
    large = np.minimum(np.minimum(high[..., :-2], high[..., 1:-1]), high[..., 2:])
    return _sorted_three(small, centre, large)[1]


def _sorted_three(a: Images, b: Images, c: Images) -> tuple[Images, Images, Images]:
    """Return the smallest, the middle and the largest of three images, pixel by pixel."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    return np.minimum(low, c), np.maximum(low, np.minimum(high, c)), np.maximum(high, c)
