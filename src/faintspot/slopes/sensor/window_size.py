"""Size limits of windows, and checks of pairs of numbers such as their size."""

from __future__ import annotations

import math

import numpy as np

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError

SMALLEST_WINDOW, LARGEST_WINDOW = 2, 64
_ABSURD = 2**31  # beyond which a whole number may not fit its type


def window_size(name: str, value: object, factor: int = 1) -> tuple[int, int]:
    """Return height and width of a window, from one number or two; its frames are binned by `factor`."""
    window, largest = pair_of_numbers(name, value, -_ABSURD, _ABSURD), LARGEST_WINDOW * factor
    if max(window) > largest:
        needed = math.ceil(max(window) / LARGEST_WINDOW)
        raise InputError(
            f"expected at most {largest}; bin = {needed} allows larger windows",
            name=name,
            value=max(window),
        )
    numbers_between(name, window, SMALLEST_WINDOW * factor, largest)
    if any(side % factor for side in window):
        raise InputError(f"expected multiples of bin = {factor}, got {window[0]} x {window[1]}", name=name)
    return window


def pair_of_numbers(name: str, value: object, low: float, high: float) -> tuple[int, int]:
    """Return two whole numbers, from one or two."""
    array = numbers_between(name, value, low, high, integer=True)
    if array.ndim > 1 or array.size not in (1, 2):
        raise InputError(f"expected one or two whole numbers, got shape {array.shape}", name=name)
    first, second = np.broadcast_to(array, 2)
    return int(first), int(second)
