"""Columns of binary tables in FITS files (standard 4.0, section 7.3), read without the others."""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.files import check_bytes
from faintspot.io.arrays.fits_units import HeaderDataUnit, StreamedArray
from faintspot.io.arrays.stored_array import MOST_WHOLE_BYTES

_PIECE_BYTES = 1 << 20
_FORMAT = re.compile(r"(\d*)([LXBIJKAEDCMPQ])")
_BYTES = {"L": 1, "A": 1, "C": 8, "M": 16, "P": 8, "Q": 16}
_NUMBERS = {"B": "u1", "I": ">i2", "J": ">i4", "K": ">i8", "E": ">f4", "D": ">f8"}


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
    header, columns, offset = unit.header, {}, 0
    row_bytes, count = int(header["NAXIS1"]), int(header["NAXIS2"])
    check_bytes(unit.name, row_bytes, MOST_WHOLE_BYTES, "a row")
    for number in range(1, int(header["TFIELDS"]) + 1):
        described = _FORMAT.match(str(header[f"TFORM{number}"]).strip())
        if described is None:
            raise ValueError(f"TFORM{number} is not known")
        repeat, code = int(described[1] or 1), described[2]
        name = str(header.get(f"TTYPE{number}", f"COLUMN{number}")).strip()
        if code in _NUMBERS and repeat:
            sides = re.findall(r"\d+", str(header.get(f"TDIM{number}", "")))
            shape = tuple(map(int, reversed(sides)))
            if not shape or math.prod(shape) != repeat:
                shape = (repeat,) if repeat > 1 else ()
            row: Any = {"names": ["values"], "formats": [(_NUMBERS[code], shape)], "offsets": [offset]}
            row["itemsize"] = row_bytes
            keys = {"BSCALE": "TSCAL", "BZERO": "TZERO", "BLANK": "TNULL"}
            cards = {key: header[f"{own}{number}"] for key, own in keys.items() if f"{own}{number}" in header}
            # NumPy refuses a field that does not fit into the row.
            columns[name] = Column(name, np.dtype(row), count, cards)
        offset += -(-repeat // 8) if code == "X" else repeat * _size(code)
    if offset != row_bytes:
        raise ValueError(f"its columns have {offset} bytes, NAXIS1 says {row_bytes}")
    return columns


def _size(code: str) -> int:
    return np.dtype(_NUMBERS[code]).itemsize if code in _NUMBERS else _BYTES[code]


class ColumnValues:
    """Stored numbers of a column, from rows that are read in pieces of bounded size."""

    def __init__(self, rows: StreamedArray, row_bytes: int) -> None:
        self._rows, self._step = rows, max(1, _PIECE_BYTES // max(row_bytes, 1))

    def __getitem__(self, part: slice) -> NDArray[Any]:
        starts = range(part.start, part.stop, self._step)
        pieces = [self._rows[first : min(first + self._step, part.stop)]["values"] for first in starts]
        return np.concatenate(pieces)
