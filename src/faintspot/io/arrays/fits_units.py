"""Header-and-data units of FITS files, read without their data."""

from __future__ import annotations

import io
import math
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from faintspot.base.errors import InputError
from faintspot.io.arrays.raw import open_plain_or_gzip
from faintspot.io.locations import one_line
from faintspot.io.optional_packages import load_fits

AOT_VERSION = "AOT-VERS"
"""Keyword in the primary header of a file of the Adaptive Optics Telemetry standard."""
_BLOCK_BYTES = 2880
_MOST_HEADER_BYTES, _MOST_PADDING_BYTES = 1 << 24, 1 << 20


@dataclass(frozen=True)
class Unit:
    """One header-and-data unit (HDU); `shape` is the image's in NumPy's order, () without an image."""

    index: int
    name: str
    header: Any
    compressed: bool
    shape: tuple[int, ...]
    data_start: int
    data_bytes: int

    @classmethod
    def of(cls, index: int, header: Any, data_start: int) -> Unit:
        """Parse a header; a wrong one raises the exceptions of astropy."""
        axes = _axes(header, "NAXIS")
        groups = int(header.get("GCOUNT", 1)) * (int(header.get("PCOUNT", 0)) + math.prod(axes))
        data_bytes = abs(int(header["BITPIX"])) // 8 * groups if axes else 0
        compressed = bool(header.get("ZIMAGE", False))
        if compressed:
            shape = _axes(header, "ZNAXIS")
        else:
            shape = axes if index == 0 or str(header.get("XTENSION", "")).strip() == "IMAGE" else ()
        if min((data_bytes, *shape)) < 0:
            raise ValueError("negative size")
        name = str(header.get("EXTNAME", "PRIMARY" if index == 0 else index))
        return cls(index, name, header, compressed, shape, data_start, data_bytes)


def _axes(header: Any, keyword: str) -> tuple[int, ...]:
    """Return the lengths of the axes in NumPy's order, the last FITS axis first."""
    return tuple(int(header[f"{keyword}{axis}"]) for axis in range(int(header[keyword]), 0, -1))


def whole_units(path: Path) -> list[Unit]:
    """Return all units of a file; nothing may follow the last one, because astropy would read it.

    Raises
    ------
    InputError
        When more data follow.
    """
    units = list(units_of(path))
    with open_plain_or_gzip(path) as stream:
        stream.seek(max((unit.data_start + unit.data_bytes for unit in units), default=0))
        if len(stream.read(_MOST_PADDING_BYTES)) == _MOST_PADDING_BYTES:
            raise InputError(f"{path}: expected the end of the file after {units[-1].name}, more follows")
    return units


def units_of(path: Path) -> Iterator[Unit]:
    """Yield the file's header-and-data units in order, skipping over the data."""
    with open_plain_or_gzip(path) as stream:
        index = 0
        while (header := _read_header(path, stream, index)) is not None:
            try:
                unit = Unit.of(index, header, stream.tell())
            except Exception as error:  # cards are parsed on access and may be broken
                raise InputError(f"{path}: header {index} is not valid FITS ({one_line(error)})") from None
            yield unit
            padded = -(-unit.data_bytes // _BLOCK_BYTES) * _BLOCK_BYTES
            try:
                stream.seek(unit.data_start + padded)
            except (OSError, EOFError, zlib.error):
                return
            index += 1


def _header_blocks(stream: IO[bytes], index: int) -> bytes:
    """Return the blocks of a header up to END; raise ValueError if there is no END."""
    start = b"SIMPLE" if index == 0 else b"XTENSION"
    text = bytearray()
    while len(text) < _MOST_HEADER_BYTES and (block := stream.read(_BLOCK_BYTES)):
        text += block
        if not text.startswith(start):
            raise ValueError(f"it does not start with {start.decode()}")
        if any(block[place : place + 8] == b"END     " for place in range(0, len(block), 80)):
            return bytes(text)
    raise ValueError(f"its header does not end within {len(text)} bytes")


def _read_header(path: Path, stream: IO[bytes], index: int) -> Any:
    """Return the header at the stream's position, or None at its end."""
    fits = load_fits()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return fits.Header.fromfile(io.BytesIO(_header_blocks(stream, index)))
    except Exception as error:  # astropy raises many kinds of errors on broken headers
        if index > 0:
            return None
        raise InputError(f"{path}: expected a FITS file ({one_line(error)})") from None
