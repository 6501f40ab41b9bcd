"""Arrays stored as plain bytes in a file or a compressed stream, read block by block."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular
from faintspot.base.npz import DAMAGE
from faintspot.base.sizes import check_bytes
from faintspot.io.locations import one_line

GZIP_SIGNATURE = b"\x1f\x8b"
_PIECE_BYTES = 1 << 20
_PIECE_NUMBERS = 1 << 18
MOST_WHOLE_BYTES = 1 << 30
"""Largest size of an array, or of a part of one, that can only be read whole."""


def open_plain_or_gzip(path: Path) -> IO[bytes]:
    """Open a file for reading; a file with the gzip signature is decompressed."""
    return cast(IO[bytes], gzip.open(path, "rb")) if is_gzip(path) else path.open("rb")


def is_gzip(path: Path) -> bool:
    """Return whether a regular file is gzip-compressed, by its first bytes."""
    check_regular(path)
    with path.open("rb") as stream:
        return stream.read(2) == GZIP_SIGNATURE


def pieces(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield a C-ordered array in pieces of bounded size along its first axis."""
    if array.ndim == 0:
        yield array
        return
    step = max(1, _PIECE_NUMBERS // max(1, math.prod(array.shape[1:])))
    for start in range(0, len(array), step):
        yield array[start : start + step]


class RawArray:
    """A C-ordered array at a byte offset of a file, or of a stream that can only be read forward.

    A stream is decompressed once from front to back if blocks are read in order; going back restarts it.
    Memory use is one block, whatever the size of the file.

    Parameters
    ----------
    name : str
        File and key, for messages.
    open_stream : callable
        Opens the stream at its first byte.
    offset : int
        Start of the array in bytes of the (decompressed) stream.
    dtype : numpy.dtype
        Type of the stored numbers, in any byte order.
    shape : tuple of int
        Shape of the array; at least one dimension.
    forward_only : bool
        Whether the stream is compressed: skipping means reading, and the checksum is verified after the last
        item.
    convert : callable, optional
        Converts stored numbers (native byte order) to values, block by block.
    """

    def __init__(
        self,
        name: str,
        open_stream: Callable[[], IO[bytes]],
        *,
        offset: int,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        forward_only: bool,
        convert: Callable[[NDArray[Any]], NDArray[Any]] | None = None,
    ) -> None:
        self.name = name
        self.shape = shape
        self._open_stream = open_stream
        self._offset = offset
        self._stored = dtype
        self._forward_only = forward_only
        self._convert = convert or (lambda array: array)
        self._item_bytes = math.prod(shape[1:]) * dtype.itemsize
        self._stream: IO[bytes] | None = None
        self._position = 0
        self.dtype: np.dtype[Any] = self._convert(np.zeros(1, dtype.newbyteorder("="))).dtype

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, in native byte order.

        Raises
        ------
        InputError
            When the file is damaged or ends too early; the message names the first lost item.
        """
        block = np.empty((stop - start, *self.shape[1:]), self._stored)
        view = memoryview(block.reshape(-1).view(np.uint8).data)
        first = self._offset + start * self._item_bytes
        try:
            self._go_to(first)
            self._fill(view)
            if self._forward_only and stop == self.shape[0]:
                self._read_to_end()
        except DAMAGE as error:
            lost = min(max(start, (self._position - self._offset) // self._item_bytes), self.shape[0] - 1)
            self.close()
            what = "frame" if len(self.shape) == 3 else "row"
            raise InputError(
                f"{self.name}: {what} {lost} (counted from 0) cannot be read: "
                f"the file is damaged or incomplete ({one_line(error)})"
            ) from None
        if not block.dtype.isnative:
            block = block.byteswap(inplace=True).view(block.dtype.newbyteorder("="))
        return self._convert(block)

    def close(self) -> None:
        """Close the stream; a later `read` opens it again."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _go_to(self, position: int) -> None:
        if self._stream is None or (self._forward_only and position < self._position):
            self.close()
            self._position = 0
            self._stream = self._open_stream()
        if not self._forward_only:
            self._stream.seek(position)
            self._position = position
        while self._position < position:
            piece = self._stream.read(min(_PIECE_BYTES, position - self._position))
            if not piece:
                raise EOFError("the data end too early")
            self._position += len(piece)

    def _fill(self, view: memoryview) -> None:
        """Fill `view` from the stream; from a compressed stream item by item, to locate damage."""
        assert self._stream is not None
        filled = 0
        while filled < len(view):
            piece = self._item_bytes if self._forward_only else len(view)
            read = self._stream.readinto(view[filled : filled + piece])  # type: ignore[attr-defined]
            if not read:
                raise EOFError("the data end too early")
            filled += read
            self._position += read

    def _read_to_end(self) -> None:
        """Read the rest of the stream: a compressed stream verifies its checksum only at its end."""
        assert self._stream is not None
        while piece := self._stream.read(_PIECE_BYTES):
            self._position += len(piece)


class WholeArray:
    """An array that can only be read whole, on first use.

    Parameters
    ----------
    name : str
        File and key, for messages.
    shape : tuple of int
    dtype : numpy.dtype
        Shape and type stated by the file; they are checked against the memory limit before reading.
    load : callable
        Returns the array; may raise any error on damaged files.
    """

    def __init__(
        self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], load: Callable[[], NDArray[Any]]
    ) -> None:
        self.name, self.shape = name, shape
        self.dtype: np.dtype[Any] = dtype.newbyteorder("=")
        self._load = load
        self._array: NDArray[Any] | None = None
        check_bytes(name, math.prod(shape) * dtype.itemsize, MOST_WHOLE_BYTES, "an array")

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, C-ordered in native byte order."""
        try:
            array = self._load() if self._array is None else self._array
            if array.shape != self.shape:
                raise ValueError(f"its shape is {array.shape} instead of {self.shape}")
        except InputError:
            raise
        except Exception as error:  # decoders raise many kinds of errors
            raise InputError(
                f"{self.name}: cannot be read: the file is damaged ({one_line(error)})"
            ) from None
        self._array = array
        return np.array(array[start:stop], dtype=self.dtype, order="C")

    def close(self) -> None:
        """Discard the array; a later `read` loads it again."""
        self._array = None


class MappedArray:
    """An array that NumPy has memory-mapped."""

    def __init__(self, name: str, array: NDArray[Any]) -> None:
        self.name = name
        self.shape: tuple[int, ...] = array.shape
        self.dtype: np.dtype[Any] = array.dtype.newbyteorder("=")
        self._array = array

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, C-ordered in native byte order."""
        return np.array(self._array[start:stop], dtype=self.dtype, order="C")

    def close(self) -> None:
        """Do nothing: only the mapping is open."""
