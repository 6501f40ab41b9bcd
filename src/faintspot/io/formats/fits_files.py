"""FITS files: frames and columns of tables, plain, gzip- (.gz) or tile-compressed (.fz); slopes.

Values follow the FITS standard 4.0, section 4.4.2: physical = BZERO + BSCALE * stored, and BLANK marks
integers without a value, which become NaN.
"""

import gzip
import warnings
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, load_package
from faintspot.base.files import check_bytes
from faintspot.base.flags import VARIABLES
from faintspot.base.text_files import parse_json, to_json
from faintspot.io import fits_units
from faintspot.io.file_format import (
    COORDINATE_UNITS,
    REQUIRED,
    FileFormat,
    StoredSlopes,
    check_stated,
    most_slopes_bytes,
    unit_of,
    with_absent,
)
from faintspot.io.stored_array import StoredArray, listed_shapes, one_line

_BLOCK_BYTES, _PIECE_BYTES = 2880, 1 << 20


class Fits(FileFormat):
    """Frames in an image; slopes with each quantity in an image extension of its name, with checksums."""

    name = "FITS"
    signatures: tuple[bytes, ...] = (b"SIMPLE", fits_units.GZIP_SIGNATURE)
    endings: tuple[str, ...] = (".fits",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return an image of a file: the first, or the one whose EXTNAME or number is `key`.

        `key` may also name a column of a binary table, (rows, ...). For a file of the AOT standard, return
        the frames of the sensor `key`, by default of the only one.
        """
        if fits_units.AOT_VERSION in next(fits_units.units_of(path)).header:
            from faintspot.io.aot_reading import read_aot

            names = {
                name for unit in fits_units.units_of(path) for name in (unit.name.upper(), str(unit.index))
            }
            if key is None or key.strip().upper() not in names:
                sensor = read_aot(path, key)
                if sensor.pixels is None:
                    raise InputError(
                        f"{path}: sensor {sensor.name!r}: expected frames (pixel_intensities of its "
                        "detector), found none"
                    )
                key = sensor.pixels
        unit, column = _find_unit(path, key)
        key = unit.name if key is None and unit.index else key
        name = f"{path}:{key}" if key is not None else str(path)
        return _image(name, path, unit) if column is None else _column(name, path, unit, column)

    def names(self, path: Path) -> list[str]:
        """Return the names of images and of columns of numbers."""
        return [name for unit in fits_units.units_of(path) for name in (_columns(path, unit) or _name(unit))]

    def require(self) -> None:
        """Raise MissingExtraError when astropy is not installed."""
        load_package("astropy.io.fits")

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write an image extension for each variable and coordinate, and ATTRIBUTES: a JSON text as bytes.

        One of them is in memory at a time.
        """
        fits = load_package("astropy.io.fits")
        count, width = slopes.variables["x"].shape
        cards = [
            ("CREATOR", "faintspot"),
            ("NFRAMES", count, "frames, the second axis of every variable"),
            ("NSUBAP", width, "sub-apertures, the first axis of every variable"),
        ]
        primary = fits.PrimaryHDU(header=fits.Header(cards))
        primary.header.set("EXTEND", True, after="NAXIS")
        _write_unit(stream, primary)
        for name, values in slopes.variables.items():
            _write_image(stream, name, values[:], unit_of(name, slopes.attributes), VARIABLES[name].long_name)
        for name, values in slopes.coordinates.items():
            _write_image(stream, name, values, COORDINATE_UNITS.get(name, "1"), "of each sub-aperture")
        text = np.frombuffer(to_json(slopes.attributes).encode(), np.uint8)
        _write_image(stream, "attributes", text, "1", "JSON text, UTF-8")

    def read(self, path: Path) -> StoredSlopes:
        """Read a file of slopes and verify its checksums."""
        units = {unit.name.lower(): unit for unit in fits_units.units_of(path)}
        total = sum(unit.value_bytes for unit in units.values())
        check_bytes(path, total, most_slopes_bytes(), "slopes")
        check_stated(path, {name: units[name].shape for name in VARIABLES if name in units})
        fits = load_package("astropy.io.fits")
        with warnings.catch_warnings(), fits_units.open_plain_or_gzip(path) as stream:
            warnings.simplefilter("error")  # astropy only warns of truncated files and wrong checksums
            with fits.open(stream, memmap=False, checksum=True) as opened:
                arrays = {unit.name.lower(): unit.data for unit in opened if unit.data is not None}
        variables = with_absent(
            {
                name: arrays.pop(name).astype(variable.dtype)
                for name, variable in VARIABLES.items()
                if name in arrays
            }
        )
        attributes = parse_json(arrays.pop("attributes").tobytes())
        coordinates = {name: array.astype(array.dtype.newbyteorder("=")) for name, array in arrays.items()}
        return StoredSlopes(variables, coordinates, attributes, True, len(variables["x"]))

    def has_slopes(self, path: Path) -> bool:
        """Return whether the extensions have the names of slopes."""
        return {name.upper() for name in (*REQUIRED, "attributes")} <= {
            unit.name for unit in fits_units.units_of(path)
        }


class FitsGz(Fits):
    """Slopes in a gzip-compressed file."""

    signatures = ()  # frames are read by `Fits`
    endings = (".fits.gz",)

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write without a time stamp, so that equal slopes give equal files."""
        with gzip.GzipFile(filename="", mode="wb", compresslevel=1, fileobj=stream, mtime=0) as compressed:
            super().write(cast(IO[bytes], compressed), slopes)


def _name(unit: fits_units.HeaderDataUnit) -> list[str]:
    return [unit.name] if unit.shape else []


def _columns(path: Path, unit: fits_units.HeaderDataUnit) -> dict[str, fits_units.Column]:
    """Return the columns of a binary table; of another unit none."""
    if not fits_units.is_table(unit):
        return {}
    try:
        return fits_units.columns_of(unit)
    except Exception as error:  # cards are parsed on access and may be broken
        raise InputError(f"{path}: table {unit.name} is damaged ({one_line(error)})") from None


def _find_unit(path: Path, key: str | None) -> tuple[fits_units.HeaderDataUnit, fits_units.Column | None]:
    """Return the primary image, the only one of two axes or more, else any; or the one or column `key`."""
    names, images, wanted = [], list[fits_units.HeaderDataUnit](), "" if key is None else key.strip().upper()
    for unit in fits_units.units_of(path):
        columns = _columns(path, unit)
        listed = f" (a binary table; name a column, as {path.name}:COLUMN: {', '.join(columns)})"
        names.append(unit.name + (listed if columns else ""))
        if key is None and unit.shape:
            if len(unit.shape) > 1 and not unit.index:
                return unit, None
            images.append(unit)
        if wanted in (unit.name.upper(), str(unit.index)):
            if not unit.shape:
                found = names[-1] if columns else "none there"
                raise InputError(f"{path}: expected an image in extension {key!r}, found {found}")
            return unit, None
        column = next((column for name, column in columns.items() if name.upper() == wanted), None)
        if column is not None:
            return unit, column
    frames = [unit for unit in images if len(unit.shape) > 1]  # not the single number that some cameras write
    if len(frames) > 1:
        shapes = listed_shapes({unit.name: unit.shape for unit in frames})
        raise InputError(
            f"{path}: expected one image, it contains: {shapes}; choose one with {path.name}:NAME"
        )
    if images:
        return (frames or images)[0], None
    sought = "an image" if key is None else f"an extension or a column {key!r}"
    raise InputError(f"{path}: expected {sought}, the file has only: {', '.join(names)}")


def _column(name: str, path: Path, unit: fits_units.HeaderDataUnit, column: fits_units.Column) -> StoredArray:
    """Return a column of a binary table."""
    compressed = fits_units.is_gzip(path)
    if not compressed:
        fits_units.check_present(name, path, unit.data_start + unit.header.data_size)
    values = _Image(name, column.cards, column.stored_type)

    def open_array(files: ExitStack) -> Any:
        stream = files.enter_context(fits_units.open_plain_or_gzip(path))
        rows = fits_units.StreamedArray(stream, unit.data_start, column.rows, (column.length,))
        values.stored = fits_units.ColumnValues(rows, column.rows.itemsize)
        return values

    return StoredArray(name, column.shape, values[:].dtype, open_array)


def _image(name: str, path: Path, unit: fits_units.HeaderDataUnit) -> StoredArray:
    """Return the image of a unit: of plain bytes, or decompressed tile by tile by astropy."""
    fits = load_package("astropy.io.fits")
    compressed_file = fits_units.is_gzip(path)
    if not compressed_file:
        fits_units.check_present(name, path, unit.data_start + unit.header.data_size)
    unit.check_tiles(name, path)
    bits = unit.header["ZBITPIX" if unit.compressed else "BITPIX"]
    if bits not in fits.BITPIX2DTYPE:
        raise InputError(f"{name}: BITPIX = {bits}: expected one of {', '.join(map(str, fits.BITPIX2DTYPE))}")
    stored_type = np.dtype(fits.BITPIX2DTYPE[bits])
    image = _Image(name, unit.header, stored_type)

    def open_array(files: ExitStack) -> Any:
        stream = files.enter_context(fits_units.open_plain_or_gzip(path))
        if unit.compressed:
            units = fits.open(stream, memmap=False, do_not_scale_image_data=True)
            image.stored = files.enter_context(units)[unit.index].section
        else:
            numbers, start = stored_type.newbyteorder(">"), unit.data_start
            image.stored = fits_units.StreamedArray(
                stream, start, numbers, unit.shape, compressed=compressed_file
            )
        return image

    return StoredArray(name, unit.shape, image[:].dtype, open_array, chunks=unit.tile)


class _Image:
    """Physical values of an image or a column, from stored numbers and the cards of its header.

    astropy leaves BLANK aside in unsigned integers, and so cannot scale.
    """

    def __init__(self, name: str, header: Mapping[str, Any], stored_type: np.dtype[np.generic]) -> None:
        self.stored: Any = np.zeros(1, stored_type)
        try:
            self._scale, self._zero = float(header.get("BSCALE", 1.0)), float(header.get("BZERO", 0.0))
            self._blank = int(header["BLANK"]) if "BLANK" in header and stored_type.kind != "f" else None
        except Exception as error:  # cards are parsed on access and may be broken
            raise InputError(f"{name}: BSCALE, BZERO and BLANK must be numbers ({one_line(error)})") from None

    def __getitem__(self, part: Any) -> NDArray[np.generic]:
        stored = np.asarray(self.stored[part])
        stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
        if self._blank is None and self._scale == 1.0 and self._zero == 0.0:
            return stored
        bits = 8 * stored.itemsize
        if self._blank is None and self._scale == 1.0 and stored.dtype.kind != "f":
            # An offset of half the range flips one bit: FITS stores the other signedness so.
            other = np.dtype(f"{'i' if bits == 8 else 'u'}{stored.itemsize}")
            if self._zero == (-128.0 if bits == 8 else 2.0 ** (bits - 1)):
                unsigned = stored.view(f"u{stored.itemsize}")
                flipped: NDArray[np.generic] = unsigned ^ unsigned.dtype.type(1 << (bits - 1))
                return flipped.view(other)
        is_single = bits <= 16 or (stored.dtype.kind == "f" and bits == 32)
        values: NDArray[np.floating[Any]] = stored.astype(np.float32 if is_single else np.float64)
        values *= self._scale
        values += self._zero
        if self._blank is not None:
            values[stored == self._blank] = np.nan
        return values


def _write_image(stream: IO[bytes], name: str, values: NDArray[np.generic], units: str, comment: str) -> None:
    """Write one image extension; FITS stores bool as bytes."""
    stored = values.view(np.uint8) if values.dtype == np.bool_ else values
    fits = load_package("astropy.io.fits")
    header = fits.Header([("EXTNAME", name.upper()), ("BUNIT", units), ("COMMENT", comment)])
    _write_unit(stream, fits.ImageHDU(stored.astype(stored.dtype.newbyteorder(">")), header))


def _write_unit(stream: IO[bytes], unit: Any) -> None:
    """Write a header-and-data unit with its checksums, without their time."""
    unit.add_checksum(when="")
    stream.write(unit.header.tostring().encode("ascii"))
    if unit.data is not None:
        content = unit.data.reshape(-1).view(np.uint8)
        for start in range(0, content.size, _PIECE_BYTES):
            stream.write(content[start : start + _PIECE_BYTES])
        stream.write(bytes(-content.size % _BLOCK_BYTES))
