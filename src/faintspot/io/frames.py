"""Input of frames, in blocks of bounded memory; formats of files: subclasses of `FileFormat` in `formats`."""

import math
import warnings
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, MissingExtraError, import_modules
from faintspot.base.files import Closing, check_bytes, check_regular, check_size
from faintspot.io.file_format import FileFormat
from faintspot.io.stored_array import (
    CHANNELS,
    MOST_WHOLE_BYTES,
    StoredArray,
    arranged,
    of_colours,
    one_line,
    split_location,
)

import_modules("faintspot.io.formats")


FORMATS: tuple[FileFormat, ...] = tuple(kind() for kind in FileFormat.kinds)
_SIGNATURE_BYTES = 8


def frame_format(path: Path) -> FileFormat:
    """Return the format of a file of frames, recognised by content.

    Raises
    ------
    InputError
        When it has no known format.
    OSError
        When it cannot be read.
    """
    start = b""
    if not path.is_dir():
        check_regular(path)
        with path.open("rb") as stream:
            start = stream.read(_SIGNATURE_BYTES)
        if not start:
            raise InputError(f"{path}: expected frames, the file is empty")
    for item in FORMATS:
        if item.has_frames(path, start):
            return item
    names = list(dict.fromkeys(item.name for item in FORMATS if item.signatures))
    raise InputError(
        f"{path}: expected a {_listed(names)} file, a text (.csv, .txt, .dat) or a Zarr store, it is none of "
        "them"
    )


def slope_format(path: Path) -> FileFormat:
    """Return the format of a file of slopes, by the ending of its name.

    Raises
    ------
    InputError
        When the ending is unknown.
    """
    for item in FORMATS:
        if path.name.lower().endswith(item.endings):
            return item
    raise InputError(f"{path}: expected a name ending in {_listed(slope_endings())}")


def slope_endings() -> list[str]:
    """Return all endings of files of slopes."""
    return [ending for item in FORMATS for ending in item.endings]


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


_MOST_PIXELS = 1 << 26  # in a frame: 8192 x 8192


class FrameSource(Closing):
    """Frames of one or several files as one sequence, for one thread at a time.

    Reading in order is fast for every format; going back in a compressed file starts again from its
    beginning.

    Attributes
    ----------
    shape : tuple of int
        Height and width of a frame in pixels.
    n_frames : int
        Total number of frames in all files.
    dtype : numpy.dtype
        Data type of every block.
    description : str
        The file names, for messages.
    note : str
        How the files were understood, if that is not evident.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.io import open_frames
    >>> np.save("frames.npy", np.arange(50.0)[:, None, None] * np.ones((64, 64)))
    >>> with open_frames(["frames.npy"]) as frames:
    ...     for first, block in frames.blocks(0, frames.n_frames, 20):
    ...         print(first, block.shape)
    0 (20, 64, 64)
    20 (20, 64, 64)
    40 (10, 64, 64)
    """

    def __init__(self, arrays: Sequence[StoredArray]) -> None:
        self._arrays = arrays
        self._starts = [0, *accumulate(_frame_count(array) for array in arrays)]
        self._open: StoredArray = arrays[0]
        self.shape: tuple[int, int] = (arrays[0].shape[-2], arrays[0].shape[-1])
        self.n_frames: int = self._starts[-1]
        self.dtype: np.dtype[Any] = np.result_type(*(array.dtype for array in arrays))
        others = f" and {len(arrays) - 1} more" if len(arrays) > 1 else ""
        self.note: str = next((array.note for array in arrays if array.note), "")
        self.description: str = f"{arrays[0].name}{others}"

    def block(self, start: int, stop: int) -> NDArray[Any]:
        """Return frames `start` to `stop` (exclusive), shape (stop - start, height, width).

        The array belongs to the caller and is in native byte order.

        Raises
        ------
        InputError
            When the range is not within the sequence, or the file is damaged there; the message names the
            frames.
        """
        if not 0 <= start < stop <= self.n_frames:
            raise InputError(f"frames {start} to {stop} of {self.description}: expected 0 to {self.n_frames}")
        first = bisect_right(self._starts, start) - 1
        parts = []
        for number in range(first, len(self._arrays)):
            begin, end = self._starts[number], self._starts[number + 1]
            if begin >= stop:
                break
            parts.append(self._read(self._arrays[number], max(start, begin) - begin, min(stop, end) - begin))
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return whole.astype(self.dtype, copy=False)

    def blocks(self, start: int, stop: int, size: int) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield (first frame, block) from `start` to `stop` in blocks of up to `size` frames."""
        for first in range(start, stop, size):
            yield first, self.block(first, min(first + size, stop))

    def close(self) -> None:
        """Close the open file, if any."""
        self._open.close()

    def _read(self, array: StoredArray, start: int, stop: int) -> NDArray[np.generic]:
        """Read from one file, keeping at most one open: there may be thousands."""
        if array is not self._open:
            self._open.close()
            self._open = array
        if len(array.shape) == 2:
            return array.read(0, array.shape[0])[np.newaxis]
        return array.read(start, stop)


def open_frames(
    paths: Sequence[str | Path], *, key: str | None = None, time_axis: int | None = None
) -> FrameSource:
    """Open files of frames, concatenated in the order given.

    FITS (plain, .gz, .fz), TIFF, PNG, BMP, JPEG, HDF5, MATLAB, .npy, .npz and Zarr stores are recognised by
    content. Each holds a cube (n, height, width) or a single frame (height, width); other axes of length one
    are dropped. Images and cubes in colours, (n, height, width, 3) or (n, 3, height, width), are read if the
    colours are equal, or one is selected: "file.png:green", "file.h5:green", "file.h5:NAME:green".

    Parameters
    ----------
    paths : sequence of str or Path
        Files; "file.npz:key", "file.fits:EXTNAME", "file.tif:NUMBER" (a series of pages) or "store.zarr:path"
        select one of several arrays. Default: the primary image of a FITS file, all pages of a TIFF file,
        else the array named "frames", or the only 2-D or 3-D array.
    key : str, optional
        Array to read from every file whose name does not select one.
    time_axis : {0, 1, 2}, optional
        Axis of cubes that counts the frames. Default: 0, or the odd one of three of which two are equal.

    Raises
    ------
    InputError
        When a file is missing, damaged, of another format, or does not hold real frames of the same size.
    MissingExtraError
        When the package that reads the format is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.io import open_frames
    >>> np.save("first.npy", np.zeros((30, 64, 64)))
    >>> np.save("second.npy", np.ones((20, 64, 64)))
    >>> frames = open_frames(["first.npy", "second.npy"])
    >>> frames.n_frames, frames.shape
    (50, (64, 64))
    """
    if isinstance(paths, str | Path):
        paths = [paths]
    if not paths:
        raise InputError("frames: expected at least one file, got none")
    arrays: list[StoredArray] = []
    for path in paths:
        array = arranged(_find_array(path, key, colours=True), time_axis)
        _check_frames(array)
        if arrays and array.shape[-2:] != arrays[0].shape[-2:]:
            raise InputError(
                f"{array.name}: its frames are {_size(array)} px (height x width), "
                f"those of {arrays[0].name} are {_size(arrays[0])}; expected frames of one size"
            )
        arrays.append(array)
    return FrameSource(arrays)


def read_array(location: str | Path) -> NDArray[np.generic]:
    """Read one whole array (dark, flat, bad-pixel map) from a file of any frame format.

    Parameters
    ----------
    location : str or Path
        File; "file.npz:key", "file.fits:EXTNAME" or "store.zarr:path" select one of several arrays.

    Returns
    -------
    ndarray
        Real or boolean values in native byte order, with the stored shape.

    Raises
    ------
    InputError
        When the file is missing, damaged, of another format or does not hold a real array.
    MissingExtraError
        When the package that reads the format is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.io import read_array
    >>> np.savez("calibration.npz", dark=np.full((64, 64), 100.0), flat=np.ones((64, 64)))
    >>> float(read_array("calibration.npz:dark").mean())
    100.0
    """
    array = _find_array(location, None)
    if array.dtype.kind not in "biuf":
        raise InputError(f"{array.name}: expected real numbers, got dtype {array.dtype}")
    if min(array.shape) < 1:
        raise InputError(f"{array.name}: expected at least one value, got shape {array.shape}")
    check_bytes(array.name, math.prod(array.shape) * array.dtype.itemsize, MOST_WHOLE_BYTES, "an array")
    check_size(array.name, array.shape)
    with array:
        return array.read(0, array.shape[0])


def _find_array(location: str | Path, key: str | None, *, colours: bool = False) -> StoredArray:
    """Find the array in a file of any format; `colours`: one channel of frames in colours."""
    path, own_key = split_location(location)
    key = key if own_key is None else own_key
    try:
        file_format = frame_format(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or one_line(error)})") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array = _with_channel(file_format, path, key) if colours else file_format.find(path, key)
    except (InputError, MissingExtraError):
        raise
    except Exception as error:  # readers raise many kinds of errors on damaged files
        raise InputError(f"{path}: expected a whole {file_format.name} file ({one_line(error)})") from None
    if not array.shape:
        raise InputError(f"{array.name}: expected an array, got a single number")
    return array


def _with_channel(file_format: FileFormat, path: Path, key: str | None) -> StoredArray:
    """Return the array `key`; if that ends in a colour and is none, this channel of the array before it."""
    name, _, channel = ("" if key is None else key).rpartition(":")
    try:
        return of_colours(file_format.find(path, key), None)
    except Exception:  # whatever a reader says of a name that is none
        if channel not in CHANNELS:
            raise
    return of_colours(file_format.find(path, name or None), channel)


def _check_frames(array: StoredArray) -> None:
    """Refuse an array that is neither a cube nor a frame."""
    if array.dtype.kind not in "iuf":
        raise InputError(f"{array.name}: expected frames of real numbers, got dtype {array.dtype}")
    if len(array.shape) not in (2, 3):
        raise InputError(
            f"{array.name}: expected (frames, height, width) or (height, width), got shape {array.shape}"
        )
    if min(array.shape) < 1:
        raise InputError(f"{array.name}: expected at least one frame and pixel, got shape {array.shape}")
    check_size(f"{array.name}: its frames", array.shape[-2:], _MOST_PIXELS, "pixels")


def _frame_count(array: StoredArray) -> int:
    return array.shape[0] if len(array.shape) == 3 else 1


def _size(array: StoredArray) -> str:
    return f"{array.shape[-2]} x {array.shape[-1]}"
