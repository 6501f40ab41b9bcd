"""FITS files: frames, plain, gzip-compressed (.gz) or tile-compressed (.fz); slopes, plain or .gz.

The headers are read by astropy; the numbers of uncompressed images are read here, block by block, which
works the same on a plain file and on a gzip stream. Values follow the FITS standard 4.0, section 4.4.2:
physical = BZERO + BSCALE * stored, and BLANK marks integers without a value, which become NaN.
"""

from __future__ import annotations

import gzip
import io
import math
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.sizes import check_bytes
from faintspot.io.file_format import FileFormat
from faintspot.io.locations import StoredArray, one_line
from faintspot.io.optional_packages import load_fits
from faintspot.io.raw import GZIP_SIGNATURE, RawArray, is_gzip, open_plain_or_gzip
from faintspot.io.slopes_format import REQUIRED, VARIABLES, StoredSlopes, check_stated, most_slopes_bytes

AOT_VERSION = "AOT-VERS"
"""Keyword of the primary header of a file of the Adaptive Optics Telemetry standard."""
_BLOCK_BYTES = 2880
_MOST_HEADER_BYTES, _MOST_PADDING_BYTES = 1 << 24, 1 << 20
_STORED = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}


class Fits(FileFormat):
    """Frames in an image; slopes with every quantity in an image extension of its name, with checksums."""

    name = "FITS"
    signatures: tuple[bytes, ...] = (b"SIMPLE", GZIP_SIGNATURE)
    endings: tuple[str, ...] = (".fits",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return an image of a file: the first, or the one whose EXTNAME or number is `key`.

        Of a file of the AOT standard it is the frames of the sensor `key`, or of the only one.
        """
        if AOT_VERSION in next(units_of(path)).header:
            names = {name for unit in units_of(path) for name in (unit.name.upper(), str(unit.index))}
            if key is None or key.strip().upper() not in names:
                from faintspot.io.aot_reading import frames_of_aot

                key = frames_of_aot(path, key)
        return _find_fits(path, key)

    def require(self) -> None:
        """Raise MissingExtraError when astropy is absent."""
        load_fits()

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write an image extension for every variable and coordinate, and one for the attributes."""
        from faintspot.io.slopes_fits import write_fits

        write_fits(stream, slopes)

    def read(self, path: Path) -> StoredSlopes:
        """Read a file of slopes, and verify its checksums."""
        from faintspot.io.slopes_fits import read_fits

        units = {unit.name.lower(): unit for unit in whole_units(path)}
        check_bytes(path, sum(unit.data_bytes for unit in units.values()), most_slopes_bytes(), "slopes")
        check_stated(path, {name: units[name].shape for name in VARIABLES if name in units})
        return read_fits(path)

    def has_slopes(self, path: Path) -> bool:
        """Tell by the names of the extensions."""
        return {name.upper() for name in (*REQUIRED, "attributes")} <= {unit.name for unit in units_of(path)}


class FitsGz(Fits):
    """Slopes in a gzip-compressed file."""

    signatures = ()  # its frames are those of `Fits`
    endings = (".fits.gz",)

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write without a time stamp, so that equal slopes give equal files."""
        with gzip.GzipFile(filename="", mode="wb", compresslevel=1, fileobj=stream, mtime=0) as compressed:
            super().write(cast(IO[bytes], compressed), slopes)


@dataclass(frozen=True)
class _Unit:
    """One header-and-data unit (HDU); `shape` is the image's in NumPy's order, () when it is no image."""

    index: int
    name: str
    header: Any
    compressed: bool
    shape: tuple[int, ...]
    data_start: int
    data_bytes: int

    @classmethod
    def of(cls, index: int, header: Any, data_start: int) -> _Unit:
        """Understand a header; a wrong one raises whatever astropy makes of it."""
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


def _find_fits(path: Path, key: str | None) -> StoredArray:
    """Return an image of a FITS file: the first, or the one whose EXTNAME or number is `key`.

    Raises
    ------
    InputError
        When the file is no FITS file, is truncated or has no such image.
    MissingExtraError
        When astropy is not installed.
    """
    unit = _find_unit(path, key)
    name = f"{path}:{key}" if key is not None else str(path)
    compressed_file = is_gzip(path)
    needed, present = unit.data_start + unit.data_bytes, path.stat().st_size
    if not compressed_file and present < needed:
        raise InputError(
            f"{name}: truncated: its header promises data up to byte {needed}, the file has {present} bytes"
        )
    if unit.compressed:
        return _TileCompressedImage(name, path, unit.index, unit.shape)
    bits = unit.header["BITPIX"]
    if bits not in _STORED:
        raise InputError(f"{name}: BITPIX = {bits}: expected one of {', '.join(map(str, _STORED))}")
    return RawArray(
        name,
        lambda: open_plain_or_gzip(path),
        offset=unit.data_start,
        dtype=np.dtype(_STORED[bits]),
        shape=unit.shape,
        forward_only=compressed_file,
        convert=_Scaling.of(name, unit.header),
    )


@dataclass(frozen=True)
class _Scaling:
    """Stored numbers to physical values."""

    scale: float
    zero: float
    blank: int | None

    @classmethod
    def of(cls, name: str, header: Any) -> _Scaling:
        try:
            blank = int(header["BLANK"]) if "BLANK" in header and header["BITPIX"] > 0 else None
            return cls(float(header.get("BSCALE", 1.0)), float(header.get("BZERO", 0.0)), blank)
        except Exception as error:  # cards are parsed when they are asked for, and may be broken
            raise InputError(f"{name}: BSCALE, BZERO and BLANK must be numbers ({one_line(error)})") from None

    def __call__(self, stored: NDArray[Any]) -> NDArray[Any]:
        if self.blank is None and self.scale == 1.0 and self.zero == 0.0:
            return stored
        bits = 8 * stored.itemsize
        if self.blank is None and self.scale == 1.0 and stored.dtype.kind != "f":
            # The standard's way to store the other signedness: an offset of half the range flips one bit.
            other = np.dtype(f"{'i' if bits == 8 else 'u'}{stored.itemsize}")
            if self.zero == (-128.0 if bits == 8 else 2.0 ** (bits - 1)):
                unsigned = stored.view(f"u{stored.itemsize}")
                flipped: NDArray[Any] = unsigned ^ unsigned.dtype.type(1 << (bits - 1))
                return flipped.view(other)
        is_single = bits <= 16 or (stored.dtype.kind == "f" and bits == 32)
        values: NDArray[np.floating[Any]] = stored.astype(np.float32 if is_single else np.float64)
        values *= self.scale
        values += self.zero
        if self.blank is not None:
            values[stored == self.blank] = np.nan
        return values


class _TileCompressedImage:
    """A tile-compressed image (.fz), decompressed tile by tile by astropy."""

    def __init__(self, name: str, path: Path, index: int, shape: tuple[int, ...]) -> None:
        self.name = name
        self._path = path
        self._index = index
        self._file: Any = None
        self.shape = shape
        self.dtype: np.dtype[Any] = (
            self.read(0, 1).dtype if shape and 0 not in shape else np.dtype(np.float32)
        )

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, in native byte order."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if self._file is None:
                    self._file = load_fits().open(self._path)
                values = np.asarray(self._file[self._index].section[start:stop])
        except Exception as error:  # the decompressors raise whatever they like
            self.close()
            raise InputError(
                f"{self.name}: frames {start} to {stop - 1} (counted from 0) cannot be decompressed: "
                f"the file is damaged ({one_line(error)})"
            ) from None
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    def close(self) -> None:
        """Close the file; a later `read` opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _axes(header: Any, keyword: str) -> tuple[int, ...]:
    """Return the lengths of the axes in NumPy's order, the last FITS axis first."""
    return tuple(int(header[f"{keyword}{axis}"]) for axis in range(int(header[keyword]), 0, -1))


def _find_unit(path: Path, key: str | None) -> _Unit:
    """Return the first image, or the unit named `key`."""
    names = []
    for unit in units_of(path):
        names.append(unit.name)
        if key is None and unit.shape:
            return unit
        if key is not None and (unit.name.upper() == key.strip().upper() or str(unit.index) == key):
            if not unit.shape:
                raise InputError(f"{path}: expected an image in extension {key!r}, found none there")
            return unit
    wanted = "an image" if key is None else f"an extension {key!r}"
    raise InputError(f"{path}: expected {wanted}, the file has only: {', '.join(names)}")


def whole_units(path: Path) -> list[_Unit]:
    """Return all units of a file, behind which nothing else may follow, of which astropy would read all.

    Raises
    ------
    InputError
        When something does.
    """
    units = list(units_of(path))
    with open_plain_or_gzip(path) as stream:
        stream.seek(max((unit.data_start + unit.data_bytes for unit in units), default=0))
        if len(stream.read(_MOST_PADDING_BYTES)) == _MOST_PADDING_BYTES:
            raise InputError(f"{path}: expected the end of the file after {units[-1].name}, more follows")
    return units


def units_of(path: Path) -> Iterator[_Unit]:
    """Yield the file's header-and-data units in order, skipping over the data."""
    with open_plain_or_gzip(path) as stream:
        index = 0
        while (header := _read_header(path, stream, index)) is not None:
            try:
                unit = _Unit.of(index, header, stream.tell())
            except Exception as error:  # cards are parsed when they are asked for, and may be broken
                raise InputError(f"{path}: header {index} is not valid FITS ({one_line(error)})") from None
            yield unit
            padded = -(-unit.data_bytes // _BLOCK_BYTES) * _BLOCK_BYTES
            try:
                stream.seek(unit.data_start + padded)
            except (OSError, EOFError, zlib.error):
                return
            index += 1


def _header_blocks(stream: IO[bytes], index: int) -> bytes:
    """Return the blocks of a header up to that with END; ValueError where there is none."""
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
    except Exception as error:  # a broken header makes astropy raise many things
        if index > 0:
            return None
        raise InputError(f"{path}: expected a FITS file ({one_line(error)})") from None
