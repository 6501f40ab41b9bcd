"""FITS files: frames, plain, gzip-compressed (.gz) or tile-compressed (.fz); slopes, plain or .gz.

astropy reads the headers. The numbers of uncompressed images are read here, block by block, from plain files
and gzip streams alike. Values follow the FITS standard 4.0, section 4.4.2:
physical = BZERO + BSCALE * stored, and BLANK marks integers without a value, which become NaN.
"""

from __future__ import annotations

import gzip
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.sizes import check_bytes
from faintspot.io.arrays.fits_units import AOT_VERSION, Unit, units_of, whole_units
from faintspot.io.arrays.raw import GZIP_SIGNATURE, RawArray, is_gzip, open_plain_or_gzip
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray, one_line
from faintspot.io.optional_packages import load_fits
from faintspot.io.stored.slopes_format import (
    REQUIRED,
    VARIABLES,
    StoredSlopes,
    check_stated,
    most_slopes_bytes,
)
from faintspot.io.telemetry.aot_reading import frames_of_aot

_STORED = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}


class Fits(FileFormat):
    """Frames in an image; slopes with each quantity in an image extension of its name, with checksums."""

    name = "FITS"
    signatures: tuple[bytes, ...] = (b"SIMPLE", GZIP_SIGNATURE)
    endings: tuple[str, ...] = (".fits",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return an image of a file: the first, or the one whose EXTNAME or number is `key`.

        For a file of the AOT standard, return the frames of the sensor `key`, by default of the only one.
        """
        if AOT_VERSION in next(units_of(path)).header:
            names = {name for unit in units_of(path) for name in (unit.name.upper(), str(unit.index))}
            if key is None or key.strip().upper() not in names:
                key = frames_of_aot(path, key)
        return _find_fits(path, key)

    def require(self) -> None:
        """Raise MissingExtraError when astropy is not installed."""
        load_fits()

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write an image extension for each variable and coordinate, and one for the attributes."""
        from faintspot.io.stored.slopes_fits import write_fits

        write_fits(stream, slopes)

    def read(self, path: Path) -> StoredSlopes:
        """Read a file of slopes and verify its checksums."""
        from faintspot.io.stored.slopes_fits import read_fits

        units = {unit.name.lower(): unit for unit in whole_units(path)}
        check_bytes(path, sum(unit.data_bytes for unit in units.values()), most_slopes_bytes(), "slopes")
        check_stated(path, {name: units[name].shape for name in VARIABLES if name in units})
        return read_fits(path)

    def has_slopes(self, path: Path) -> bool:
        """Return whether the extensions have the names of slopes."""
        return {name.upper() for name in (*REQUIRED, "attributes")} <= {unit.name for unit in units_of(path)}


class FitsGz(Fits):
    """Slopes in a gzip-compressed file."""

    signatures = ()  # frames are read by `Fits`
    endings = (".fits.gz",)

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write without a time stamp, so that equal slopes give equal files."""
        with gzip.GzipFile(filename="", mode="wb", compresslevel=1, fileobj=stream, mtime=0) as compressed:
            super().write(cast(IO[bytes], compressed), slopes)


def _find_fits(path: Path, key: str | None) -> StoredArray:
    """Return an image of a FITS file: the first, or the one whose EXTNAME or number is `key`.

    Raises
    ------
    InputError
        When the file is not FITS, is truncated or has no such image.
    MissingExtraError
        When astropy is not installed.
    """
    unit = _find_unit(path, key)
    name = f"{path}:{key}" if key is not None else str(path)
    compressed_file = is_gzip(path)
    needed, present = unit.data_start + unit.data_bytes, path.stat().st_size
    if not compressed_file and present < needed:
        raise InputError(
            f"{name}: truncated: its header states data up to byte {needed}, the file has {present} bytes"
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
    """Conversion of stored numbers to physical values."""

    scale: float
    zero: float
    blank: int | None

    @classmethod
    def of(cls, name: str, header: Any) -> _Scaling:
        try:
            blank = int(header["BLANK"]) if "BLANK" in header and header["BITPIX"] > 0 else None
            return cls(float(header.get("BSCALE", 1.0)), float(header.get("BZERO", 0.0)), blank)
        except Exception as error:  # cards are parsed on access and may be broken
            raise InputError(f"{name}: BSCALE, BZERO and BLANK must be numbers ({one_line(error)})") from None

    def __call__(self, stored: NDArray[Any]) -> NDArray[Any]:
        if self.blank is None and self.scale == 1.0 and self.zero == 0.0:
            return stored
        bits = 8 * stored.itemsize
        if self.blank is None and self.scale == 1.0 and stored.dtype.kind != "f":
            # An offset of half the range flips one bit: FITS stores the other signedness so.
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
        except Exception as error:  # decompressors raise many kinds of errors
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


def _find_unit(path: Path, key: str | None) -> Unit:
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
