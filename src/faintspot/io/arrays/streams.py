"""Arrays of plain bytes in a file or a compressed stream."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular

GZIP_SIGNATURE = b"\x1f\x8b"
_PIECE_BYTES = 1 << 20


def is_gzip(path: Path) -> bool:
    """Return whether a regular file is gzip-compressed, by its first bytes."""
    check_regular(path)
    with path.open("rb") as stream:
        return stream.read(2) == GZIP_SIGNATURE


def open_plain_or_gzip(path: Path) -> IO[bytes]:
    """Open a file for reading; a file with the gzip signature is decompressed."""
    return cast(IO[bytes], gzip.open(path, "rb")) if is_gzip(path) else path.open("rb")


def check_present(name: str, path: Path, stated_bytes: int) -> None:
    """Raise InputError if a file is shorter than the header of its array states."""
    n_bytes = path.stat().st_size
    if n_bytes < stated_bytes:
        raise InputError(
            f"{name}: truncated: its header states data up to byte {stated_bytes}, "
            f"the file has {n_bytes} bytes"
        )


class StreamedArray:
    """A C-ordered array at a byte offset of a stream, for `StoredArray`.

    A compressed stream is decompressed once if blocks are read in order; going back starts it again. Memory
    use is one block.

    Parameters
    ----------
    stream : binary stream
    offset : int
        Start of the array in bytes of the (decompressed) stream.
    dtype : numpy.dtype
        Type of the stored numbers, in any byte order.
    shape : tuple of int
    compressed : bool
        Read a stream to its end after the last item, where gzip and zip verify their checksums.
    """

    def __init__(
        self,
        stream: IO[bytes],
        offset: int,
        dtype: np.dtype[np.generic],
        shape: tuple[int, ...],
        *,
        compressed: bool = False,
    ) -> None:
        self._stream, self._offset, self._dtype, self._shape = stream, offset, dtype, shape
        self._compressed = compressed

    def __getitem__(self, chosen: slice | tuple[Any, ...]) -> NDArray[Any]:
        """Return items of the first axis, in native byte order; raise EOFError if the data end too early.

        Zeros may come before the slice, for axes of length one.
        """
        *ones, part = chosen if isinstance(chosen, tuple) else (chosen,)
        shape = self._shape[len(ones) :]
        values = np.empty((part.stop - part.start, *shape[1:]), self._dtype)
        self._go_to(self._offset + part.start * math.prod(shape[1:]) * self._dtype.itemsize)
        if self._stream.readinto(values.reshape(-1).view(np.uint8)) < values.nbytes:  # type: ignore[attr-defined]
            raise EOFError("the data end too early")
        while self._compressed and part.stop == shape[0] and self._stream.read(_PIECE_BYTES):
            pass
        return values.astype(self._dtype.newbyteorder("="), copy=False)

    def _go_to(self, place: int) -> None:
        """Go to a byte; a compressed stream is read up to it: zip verifies no checksum after a seek."""
        if not self._compressed or place < self._stream.tell():
            self._stream.seek(0 if self._compressed else place)
        while (left := place - self._stream.tell()) > 0 and self._stream.read(min(left, _PIECE_BYTES)):
            pass
