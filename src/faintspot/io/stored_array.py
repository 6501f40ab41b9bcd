"""An array in a file: its location, opened for the first read and read in parts; its axes, equal colours.

xarray reads few of the formats, and states no sizes of chunks before they are read.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import Closing, check_bytes

PREFERRED_NAME = "frames"
CHANNELS = ("red", "green", "blue")
_MOST_LISTED = 12


def split_location(location: str | Path) -> tuple[Path, str | None]:
    """Split "file:key" into file and key; the name of an existing file has no key.

    Raises
    ------
    InputError
        When there is no such file or directory.
    """
    whole = Path(location)
    if _exists(whole):
        return whole, None
    before, separator, key = str(location).rpartition(":")
    if separator and key and before and _exists(Path(before)):
        return Path(before), key
    if key in CHANNELS and ":" in before:
        path, name = split_location(before)
        return path, f"{name}:{key}"
    raise InputError(f"{location}: no such file or directory")


def _exists(path: Path) -> bool:
    """Return whether the file exists; False for names that no file can have."""
    try:
        return path.exists()
    except (OSError, ValueError):  # name too long, or with characters that are not allowed
        return False


def listed(names: Iterable[str]) -> str:
    """Return names with commas for a message, of many the first and the number of the others."""
    items = list(names)
    more = f" and {len(items) - _MOST_LISTED} more" if len(items) > _MOST_LISTED else ""
    return f"{', '.join(items[:_MOST_LISTED]) or 'none'}{more}"


def listed_shapes(shapes: Mapping[str, tuple[int, ...]]) -> str:
    """Return names with their shapes for a message; see `listed`."""
    sizes = {name: " x ".join(map(str, shape)) or "a number" for name, shape in shapes.items()}
    return listed(f"{name} ({size})" for name, size in sizes.items())


def choose_name(path: Path, shapes: Mapping[str, tuple[int, ...]], key: str | None) -> str:
    """Return the name of the array to read: `key`, or "frames", or the only 2-D or 3-D one.

    Parameters
    ----------
    path : Path
        The file, for messages.
    shapes : mapping
        Shape of every array in the file; () of what is none.
    key : str or None
        The requested name.

    Raises
    ------
    InputError
        When there is no such array, or several and none is requested.
    """
    if key is not None:
        if key not in shapes:
            raise InputError(f"{path}: no array {key!r}; it contains: {listed_shapes(shapes)}")
        return key
    if PREFERRED_NAME in shapes:
        return PREFERRED_NAME
    images = [name for name, shape in shapes.items() if len(shape) in (2, 3) and min(shape) > 1]
    images = images or [name for name, shape in shapes.items() if len(shape) in (2, 3)]
    images = images or [name for name, shape in shapes.items() if len(shape) > 3]
    if len(images) != 1:
        raise InputError(
            f"{path}: expected one array of frames, or one named 'frames'; "
            f"it contains: {listed_shapes(shapes)}; choose one with {path.name}:NAME"
        )
    return images[0]


def one_line(error: BaseException) -> str:
    """Return the message of another library's error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


MOST_WHOLE_BYTES = 1 << 30
"""Largest size of an array, or of a part of one, that can only be read whole."""

MOST_CHUNKS = 1 << 14
"""Most chunks of a frame, and of a part that is read at once: libraries need kilobytes for each."""

OpenArray = Callable[[ExitStack], Any]
"""Opens a file on a stack of contexts and returns an array that gives its items by ``array[start:stop]``."""


class StoredArray(Closing):
    """An array in a file whose first axis is read in parts; for one thread at a time.

    Parameters
    ----------
    name : str
        File and key, for messages.
    shape : tuple of int
        Shape stated by the file.
    dtype : numpy.dtype
        Type of the values, in any byte order; `read` returns them in native order.
    open_array : callable
        See `OpenArray`; it and the returned array may raise any error on damaged files.
    note : str
        How the file was understood, if that is not evident.
    matlab : bool
        Whether MATLAB's last axis was put first.
    chunks : tuple of int, optional
        Shape of the chunks in which the values are stored.
    compressions : int
        Number of times that a chunk is compressed.

    Raises
    ------
    InputError
        When a chunk is too large, compressed more than once, or there are too many for an item.
    """

    def __init__(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype[np.generic],
        open_array: OpenArray,
        *,
        note: str = "",
        matlab: bool = False,
        chunks: tuple[int, ...] | None = None,
        compressions: int = 0,
    ) -> None:
        self.note, self.matlab = note, matlab
        self.name, self.shape = name, tuple(int(side) for side in shape)
        self.dtype: np.dtype[Any] = dtype.newbyteorder("=")
        self._open_array = open_array
        self._open_files = ExitStack()
        self._array: Any = None
        self._most_items = math.inf
        if chunks:
            sides = zip(self.shape[1:], chunks[1:], strict=True)
            of_item = max(math.prod(-(-side // max(chunk, 1)) for side, chunk in sides), 1)
            check_bytes(name, math.prod(chunks) * dtype.itemsize, MOST_WHOLE_BYTES, "a chunk")
            if of_item > MOST_CHUNKS:
                raise InputError(
                    f"{name}: has {of_item:,} chunks in a frame, expected at most {MOST_CHUNKS:,}; save it "
                    "in larger chunks"
                )
            self._most_items = max(MOST_CHUNKS // of_item, 1) * max(chunks[0], 1)
        if compressions > 1:
            raise InputError(
                f"{name}: is compressed {compressions} times, so that its size is not known; compress it once"
            )

    @classmethod
    def whole(
        cls,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype[np.generic],
        load: Callable[[], NDArray[Any]],
        **options: Any,
    ) -> StoredArray:
        """Return an array that can only be read whole, by `load`; refuse one that needs too much memory."""
        check_bytes(name, math.prod(shape) * dtype.itemsize, MOST_WHOLE_BYTES, "an array")
        return cls(name, shape, dtype, lambda _: load(), **options)

    def opened(self, files: ExitStack) -> Any:
        """Open the file on another stack; see `OpenArray`."""
        return self._open_array(files)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, C-ordered; the array belongs to the caller.

        Raises
        ------
        InputError
            When the file is damaged or incomplete; the message names the items.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if self._array is None:
                    self._array = self._open_array(self._open_files)
                values = self._values(start, stop)
            if values.shape != (stop - start, *self.shape[1:]):
                raise ValueError(f"its shape is {values.shape[1:]} instead of {self.shape[1:]}")
        except (InputError, MissingExtraError):
            raise
        except Exception as error:  # decoders raise many kinds of errors on damaged files
            self.close()
            items = "frames" if len(self.shape) == 3 else "rows"
            raise InputError(
                f"{self.name}: {items} {start} to {stop - 1} (counted from 0) cannot be read: "
                f"the file is damaged or incomplete ({one_line(error)})"
            ) from None
        # Values without memory of their own are a part of a mapped or whole array.
        return np.array(values, self.dtype, order="C", copy=None if values.flags.owndata else True)

    def _values(self, start: int, stop: int) -> NDArray[Any]:
        if stop - start <= self._most_items:
            return np.asarray(self._array[start:stop])
        step = int(self._most_items)
        parts = [self._array[first : min(first + step, stop)] for first in range(start, stop, step)]
        return np.concatenate(parts)

    def close(self) -> None:
        """Close the file; a later `read` opens it again."""
        self._array = None
        self._open_files.close()


_SURE = 2  # times as long as the third axis are two equal ones, which are then height and width
_ALIKE, _SHORT = 1.25, 3  # ratio of axes that may be height and width; and their ratio to a short third one


def arranged(array: StoredArray, time_axis: int | None) -> StoredArray:
    """Return an array as (frames, height, width) or (height, width).

    Parameters
    ----------
    array : StoredArray
        From `of_colours`.
    time_axis : {0, 1, 2}, optional
        Axis that counts the frames. Default: 0, or the one that is not of the length of the two others.

    Raises
    ------
    InputError
        If it is not clear which axis counts the frames.
    """
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


EQUAL_COLOURS = "red, green and blue are equal, and read as grey"
"""Note about such an image."""


def grey(name: str, values: NDArray[np.generic], *, selectable: bool = True) -> NDArray[Any]:
    """Return the first of equal channels (..., h, w, 2 to 4); the second or fourth may be transparency.

    Raises
    ------
    InputError
        If the colours differ.
    """
    colours = values[..., : 3 if values.shape[-1] > 2 else 1]
    first = colours[..., :1]
    if (colours != first).any():
        part = 100 * float((colours != first).any(axis=-1).mean())
        way = (
            f"choose one with {name}:green (or red, blue)"
            if selectable
            else "save one of the colours in grey"
        )
        raise InputError(
            f"{name}: expected a grey image, its colours differ in {part:.3g} % of the pixels; {way}"
        )
    return np.ascontiguousarray(first[..., 0])


def of_colours(array: StoredArray, channel: str | None) -> StoredArray:
    """Return one channel of frames in colours, (n, h, w, 3 or 4) or (n, 3, h, w); other arrays as they are.

    Parameters
    ----------
    array : StoredArray
        Of any dimensions; axes of length one are dropped where there are more than three.
    channel : {"red", "green", "blue"}, optional
        Default: the colours are equal, which is found out while reading.

    Raises
    ------
    InputError
        If a channel is chosen of an array without colours.
    """
    array = _without_ones(array)
    is_last = len(array.shape) == 4 and array.shape[-1] in (3, 4)
    if not is_last and (len(array.shape) != 4 or array.shape[1] != 3):
        if channel is not None:
            raise InputError(f"{array.name}:{channel}: expected frames in colours, got shape {array.shape}")
        return array
    shape = array.shape[:3] if is_last else (array.shape[0], *array.shape[2:])

    def open_array(files: ExitStack) -> Any:
        return _Channel(array.name, array.opened(files), -1 if is_last else 1, channel)

    name, note = (array.name, EQUAL_COLOURS) if channel is None else (f"{array.name}:{channel}", "")
    return StoredArray(name, shape, array.dtype, open_array, note=note, matlab=array.matlab)


class _Channel:
    """A channel of frames in colours."""

    def __init__(self, name: str, array: Any, axis: int, channel: str | None) -> None:
        self._name, self._array, self._axis, self._channel = name, array, axis, channel

    def __getitem__(self, part: slice) -> NDArray[Any]:
        values = np.moveaxis(np.asarray(self._array[part]), self._axis, -1)
        return grey(self._name, values) if self._channel is None else one_channel(values, self._channel)


def one_channel(values: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    """Return a channel of images (..., h, w, 2 to 4); those of 2 have one, and transparency."""
    return np.ascontiguousarray(values[..., CHANNELS.index(name) if values.shape[-1] > 2 else 0])
