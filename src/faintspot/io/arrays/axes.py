"""Axes of stored arrays: those of length one, and which one counts the frames."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.stored_array import StoredArray

_SURE = 2  # times as long as the third axis are two equal ones, which are then height and width
_ALIKE, _SHORT = 1.25, 3  # ratio of axes that may be height and width; and their ratio to a short third one


def arranged(array: StoredArray, time_axis: int | None) -> StoredArray:
    """Return an array as (frames, height, width) or (height, width).

    Parameters
    ----------
    array : StoredArray
        Of any dimensions; axes of length one are dropped where there are more than three.
    time_axis : {0, 1, 2}, optional
        Axis that counts the frames. Default: 0, or the one that is not of the length of the two others.

    Raises
    ------
    InputError
        If it is not clear which axis counts the frames.
    """
    array = _without_ones(array)
    if len(array.shape) != 3:
        return array
    chosen = _time_axis(array) if time_axis is None else time_axis
    if chosen == 0:
        return array
    order = (chosen, *(axis for axis in range(3) if axis != chosen))
    if array.matlab:  # (frames, height, width) there is (width, frames, height) here
        order = (1, 2, 0)
    shape = tuple(array.shape[axis] for axis in order)
    note = (
        "" if time_axis is not None else f"shape {array.shape} is taken for {_in_words(array.shape, chosen)}"
    )

    def load() -> NDArray[Any]:
        with array:
            return np.ascontiguousarray(array.read(0, array.shape[0]).transpose(order))

    return StoredArray.whole(array.name, shape, array.dtype, load, note=note)


def _time_axis(array: StoredArray) -> int:
    """Return the axis that counts the frames; height and width are often equal, and seldom far apart."""
    first, second, third = array.shape
    if second == third or third < 1:
        return 0
    if third == 1:
        return 2
    for axis, (short, *others) in ((2, (third, first, second)), (1, (second, first, third))):
        if short >= min(others):
            continue
        if others[0] == others[1] and short * _SURE <= others[0]:
            return axis
        alike = max(others) <= _ALIKE * min(others) and short * _SHORT <= min(others)
        if alike or others[0] == others[1]:
            raise InputError(
                f"{array.name}: shape {array.shape} is {_in_words(array.shape, 0)}, or "
                f"{_in_words(array.shape, axis)}; state time_axis (--time-axis 0 or {axis})"
            )
    return 0


def _in_words(shape: tuple[int, ...], time_axis: int) -> str:
    height, width = (side for axis, side in enumerate(shape) if axis != time_axis)
    return f"{shape[time_axis]} frames of {height} x {width} px"


def _without_ones(array: StoredArray) -> StoredArray:
    """Return the array without axes of length one if it has more than three axes."""
    if len(array.shape) <= 3:
        return array
    shape = tuple(side for side in array.shape if side != 1)
    if not shape:
        return array
    before = next(axis for axis, side in enumerate(array.shape) if side != 1)

    def open_array(files: ExitStack) -> Any:
        return _Reshaped(array.opened(files), before, shape[1:])

    return StoredArray(array.name, shape, array.dtype, open_array, note=array.note, matlab=array.matlab)


class _Reshaped:
    """Items of an array along the first axis that is longer than one."""

    def __init__(self, array: Any, before: int, shape: tuple[int, ...]) -> None:
        self._array, self._before, self._shape = array, before, shape

    def __getitem__(self, part: slice) -> NDArray[Any]:
        values = np.asarray(self._array[(*(0,) * self._before, part)])
        return values.reshape(part.stop - part.start, *self._shape)
