"""Header-and-data units of FITS files, read without their data; columns of binary tables; images written.

Parts are not read by `section` of astropy: columns have none, gzip is not read up to its checksum, and BLANK
is left aside in unsigned integers.
"""

from __future__ import annotations

import gzip
import io
import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.errors import InputError, MissingExtraError, load_package
from faintspot.base.files import check_bytes, check_regular, write_atomically
from faintspot.io.stored_array import MOST_WHOLE_BYTES, one_line
from faintspot.io.zarr_store import check_inflated, is_surely_small

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


AOT_VERSION = "AOT-VERS"
"""Keyword in the primary header of a file of the Adaptive Optics Telemetry standard."""
SIDE = "SUBAPM"
"""Keyword of faintspot for the side of a sub-aperture, m."""


@dataclass(frozen=True)
class HeaderDataUnit:
    """One header-and-data unit (HDU); `shape` is the image's in NumPy's order, () without an image."""

    index: int
    name: str
    header: Any
    compressed: bool
    shape: tuple[int, ...]
    data_start: int

    @property
    def value_bytes(self) -> int:
        """Size of the values, decompressed."""
        if not self.compressed:
            return int(self.header.data_size)
        return math.prod(self.shape) * abs(int(self.header["ZBITPIX"])) // 8

    @property
    def tile(self) -> tuple[int, ...] | None:
        """Shape of the tiles in which an image is compressed."""
        if not self.compressed:
            return None
        n_axes = len(self.shape)
        whole_rows = {1: self.shape[-1]} if self.shape else {}
        return tuple(
            int(self.header.get(f"ZTILE{axis}", whole_rows.get(axis, 1))) for axis in range(n_axes, 0, -1)
        )

    def check_tiles(self, name: str, path: Path) -> None:
        """Refuse compressed tiles that are larger, or inflate to more, than a chunk may be.

        Raises
        ------
        InputError
            If there are such tiles.
        """
        if not self.compressed:
            return
        itemsize = abs(int(self.header["ZBITPIX"])) // 8
        check_bytes(name, math.prod(self.tile or ()) * itemsize, MOST_WHOLE_BYTES, "a chunk")
        with open_plain_or_gzip(path) as stream:
            opened = load_package("astropy.io.fits").open(
                stream, memmap=False, disable_image_compression=True
            )
            rows = np.asarray(opened[self.index].data)
            heap = self.data_start + int(self.header.get("THEAP", rows.nbytes))
            for column in {"COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"} & set(rows.dtype.names or ()):
                for size, offset in rows[column].tolist():
                    if not is_surely_small(size, "deflate"):
                        stream.seek(heap + offset)
                        if (content := stream.read(size))[:2] == GZIP_SIGNATURE:
                            check_inflated(name, content, "deflate")

    @classmethod
    def of(cls, index: int, header: Any, data_start: int) -> HeaderDataUnit:
        """Interpret a header; a wrong one raises the exceptions of astropy."""
        compressed = bool(header.get("ZIMAGE", False))
        is_image = compressed or index == 0 or str(header["XTENSION"]).strip() == "IMAGE"
        axes = "ZNAXIS" if compressed else "NAXIS"
        n_axes = int(header[axes]) if is_image else 0
        shape = tuple(int(header[f"{axes}{axis}"]) for axis in range(n_axes, 0, -1))
        if min((header.data_size, *shape)) < 0:
            raise ValueError("negative size")
        name = str(header.get("EXTNAME", "PRIMARY" if index == 0 else index))
        return cls(index, name, header, compressed, shape, data_start)


def write_images(path: str | Path, images: Mapping[str, ArrayLike]) -> None:
    """Write arrays to a FITS file, each as an image of its own.

    Parameters
    ----------
    path : path
    images : mapping
        Arrays by the names of their units.

    Raises
    ------
    InputError
        When the file cannot be written.
    MissingExtraError
        When astropy is not installed.
    """
    fits, stream = load_package("astropy.io.fits"), io.BytesIO()
    primary = fits.PrimaryHDU()
    primary.header["CREATOR"] = "faintspot"
    hdus = [fits.ImageHDU(np.atleast_1d(values), name=name) for name, values in images.items()]
    fits.HDUList([primary, *hdus]).writeto(stream, checksum=True)
    write_atomically(path, stream.getvalue())


def units_of(path: Path) -> Iterator[HeaderDataUnit]:
    """Yield the file's header-and-data units in order, skipping over the data."""
    header_type = load_package("astropy.io.fits").Header
    with open_plain_or_gzip(path) as stream:
        next_unit, index = 0, 0
        while True:
            try:
                if index == 0 and not stream.read(6) == b"SIMPLE":
                    raise ValueError("it does not start with SIMPLE")
                stream.seek(next_unit)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    header = header_type.fromfile(stream)
                    unit = HeaderDataUnit.of(index, header, stream.tell())
            except Exception as error:  # astropy raises many kinds of errors on damaged headers
                if index > 0:
                    return  # the end of the file, or data of no interest behind the last unit
                raise InputError(f"{path}: expected a FITS file ({one_line(error)})") from None
            yield unit
            next_unit = unit.data_start + header.data_size_padded
            index += 1


def is_aot(path: str | Path) -> bool:
    """Return whether a file is a FITS file of the Adaptive Optics Telemetry standard."""
    try:
        return AOT_VERSION in next(units_of(Path(path))).header
    except (InputError, MissingExtraError, OSError):  # another or a damaged file; its reader gives the reason
        return False


_MOST_COLUMNS = 999  # by the FITS standard
_NUMBERS = "BIJKED"
"""Letters of the formats of columns of numbers."""


class Column(NamedTuple):
    """A column of numbers."""

    name: str
    rows: np.dtype[Any]
    """A row of the table, with the column as its only field."""
    length: int
    """Number of rows."""
    cards: dict[str, Any]
    """Scaling, by the keywords of images: BSCALE, BZERO and BLANK."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the values, (rows, ...)."""
        return self.length, *self.rows[0].shape

    @property
    def stored_type(self) -> np.dtype[Any]:
        """Type of the stored numbers."""
        return self.rows[0].base


def is_table(unit: HeaderDataUnit) -> bool:
    """Return whether a unit is a binary table, and no compressed image."""
    return unit.index > 0 and not unit.compressed and str(unit.header["XTENSION"]).strip() == "BINTABLE"


def columns_of(unit: HeaderDataUnit) -> dict[str, Column]:
    """Return the columns of numbers by name; texts, bits and arrays of varying length are left out.

    Raises
    ------
    ValueError
        When the header is damaged.
    """
    header, columns = unit.header, {}
    row_bytes, count = int(header["NAXIS1"]), int(header["NAXIS2"])
    check_bytes(unit.name, row_bytes, MOST_WHOLE_BYTES, "a row")
    n_columns = int(header["TFIELDS"])
    if n_columns > _MOST_COLUMNS:
        raise ValueError(f"it has {n_columns} columns")
    numbered = header.copy()  # names may be missing, or occur twice
    for number in range(1, n_columns + 1):
        numbered[f"TTYPE{number}"] = f"COLUMN{number}"
    table = load_package("astropy.io.fits").BinTableHDU.fromstring(numbered.tostring().encode())
    stored = table.columns.dtype.newbyteorder(">")
    if stored.itemsize != row_bytes:
        raise ValueError(f"its columns have {stored.itemsize} bytes, NAXIS1 says {row_bytes}")
    for number, column in enumerate(table.columns, 1):
        kind, offset = stored.fields[column.name][:2]
        if column.format[-1] not in _NUMBERS or not kind.itemsize:
            continue
        row: Any = {"names": ["values"], "formats": [kind], "offsets": [offset], "itemsize": row_bytes}
        keys = {"BSCALE": "TSCAL", "BZERO": "TZERO", "BLANK": "TNULL"}
        cards = {key: header[f"{own}{number}"] for key, own in keys.items() if f"{own}{number}" in header}
        name = str(header.get(f"TTYPE{number}", column.name)).strip()
        columns[name] = Column(name, np.dtype(row), count, cards)
    return columns


class ColumnValues:
    """Stored numbers of a column, from rows that are read in pieces of bounded size."""

    def __init__(self, rows: StreamedArray, row_bytes: int) -> None:
        self._rows, self._step = rows, max(1, _PIECE_BYTES // max(row_bytes, 1))

    def __getitem__(self, part: slice) -> NDArray[Any]:
        starts = range(part.start, part.stop, self._step)
        pieces = [self._rows[first : min(first + self._step, part.stop)]["values"] for first in starts]
        return np.concatenate(pieces)
