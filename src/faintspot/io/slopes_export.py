"""Slopes as .npz, .fits and .csv files, written in blocks of frames and read back."""

from __future__ import annotations

import gzip
import json
import math
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.io.raw import open_plain_or_gzip
from faintspot.io.slopes_format import COORDINATE_UNITS, VARIABLES, StoredSlopes, with_absent

_PIECE_NUMBERS = 1 << 18
_FITS_BLOCK_BYTES = 2880
_CSV_LINES = 1 << 12
_CSV_INDEX = ("frame", "subaperture")


def write_npz(stream: IO[bytes], slopes: StoredSlopes) -> None:
    """Write every variable and coordinate, and the attributes as a JSON text named `attributes`."""
    arrays = {**slopes.variables, **slopes.coordinates}
    arrays["attributes"] = np.array(json.dumps(dict(slopes.attributes)))
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = {
                    "descr": np.lib.format.dtype_to_descr(array.dtype),
                    "fortran_order": False,
                    "shape": array.shape,
                }
                np.lib.format.write_array_header_1_0(member, header)
                for piece in _pieces(array):
                    member.write(piece.tobytes())


def read_npz(path: Path) -> StoredSlopes:
    """Read a .npz file of slopes."""
    # numpy.load leaves a file that it opened itself open when the archive is damaged.
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    variables = with_absent({name: arrays.pop(name) for name in VARIABLES if name in arrays})
    attributes = json.loads(str(arrays.pop("attributes")))
    return StoredSlopes(variables, arrays, attributes, True, len(variables["x"]))


def write_fits(stream: IO[bytes], slopes: StoredSlopes) -> None:
    """Write an image extension for every variable and coordinate, and ATTRIBUTES: a JSON text as bytes."""
    from faintspot.io.fits_files import fits

    count, width = slopes.variables["x"].shape
    primary = fits.Header(
        [
            ("SIMPLE", True),
            ("BITPIX", 8),
            ("NAXIS", 0),
            ("EXTEND", True),
            ("CREATOR", "faintspot"),
            ("NFRAMES", count, "frames, the second axis of every variable"),
            ("NSUBAP", width, "sub-apertures, the first axis of every variable"),
        ]
    )
    stream.write(primary.tostring().encode("ascii"))
    for name, array in slopes.variables.items():
        variable = VARIABLES[name]
        _write_image(stream, name, array, variable.units, variable.long_name)
    for name, array in slopes.coordinates.items():
        _write_image(stream, name, array, COORDINATE_UNITS.get(name, "1"), "of each sub-aperture")
    text = np.frombuffer(json.dumps(dict(slopes.attributes)).encode(), np.uint8)
    _write_image(stream, "attributes", text, "1", "JSON text, UTF-8")


def write_fits_gz(stream: IO[bytes], slopes: StoredSlopes) -> None:
    """Write the FITS file gzip-compressed; without a time stamp, so that equal slopes give equal files."""
    with gzip.GzipFile(filename="", mode="wb", compresslevel=1, fileobj=stream, mtime=0) as compressed:
        write_fits(cast(IO[bytes], compressed), slopes)


def read_fits(path: Path) -> StoredSlopes:
    """Read a FITS file of slopes."""
    from faintspot.io.fits_files import fits

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # astropy only warns of a truncated file
        try:
            with open_plain_or_gzip(path) as stream, fits.open(stream, memmap=False) as units:
                arrays = {unit.name.lower(): _native(unit.data) for unit in units[1:]}
        except Warning as warning:
            raise ValueError(str(warning)) from None
    variables = with_absent(
        {name: arrays.pop(name).astype(VARIABLES[name].dtype) for name in VARIABLES if name in arrays}
    )
    attributes = json.loads(arrays.pop("attributes").tobytes())
    return StoredSlopes(variables, arrays, attributes, True, len(variables["x"]))


def write_csv(stream: IO[bytes], slopes: StoredSlopes) -> None:
    """Write one line per frame and sub-aperture; floats with the fewest digits that give them back."""
    names = [*_CSV_INDEX, *(variable.csv_name for variable in VARIABLES.values())]
    stream.write((",".join(names) + "\n").encode())
    count, width = slopes.variables["x"].shape
    step = max(1, _CSV_LINES // width)
    for start in range(0, count, step):
        stop = min(start + step, count)
        frames, subapertures = np.divmod(np.arange(start * width, stop * width), width)
        columns = [frames, subapertures]
        for name in VARIABLES:
            piece = np.asarray(slopes.variables[name][start:stop]).reshape(-1)
            columns.append(piece.view(np.uint8) if piece.dtype == np.bool_ else piece)
        lines = zip(*(column.astype(str).tolist() for column in columns), strict=True)
        stream.write("".join(",".join(line) + "\n" for line in lines).encode())


def read_csv(path: Path) -> StoredSlopes:
    """Read a .csv file of slopes; it has neither coordinates nor attributes."""
    with path.open(encoding="utf-8") as stream:
        names = stream.readline().strip().split(",")
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    width = int(table[:, names.index("subaperture")].max()) + 1
    variables = with_absent(
        {
            name: table[:, names.index(variable.csv_name)].reshape(-1, width).astype(variable.dtype)
            for name, variable in VARIABLES.items()
            if variable.csv_name in names
        }
    )
    return StoredSlopes(variables, {}, {}, True, len(variables["x"]))


def _pieces(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield a C-ordered array in pieces of bounded size along its first axis."""
    if array.ndim == 0:
        yield array
        return
    step = max(1, _PIECE_NUMBERS // max(1, math.prod(array.shape[1:])))
    for start in range(0, len(array), step):
        yield array[start : start + step]


def _write_image(stream: IO[bytes], name: str, array: NDArray[Any], units: str, comment: str) -> None:
    """Write one image extension; numbers in FITS are big-endian, and a bool is a byte."""
    from faintspot.io.fits_files import fits

    stored = array.dtype if array.dtype != np.bool_ else np.dtype(np.uint8)
    if stored.kind == "u" and stored.itemsize > 1:
        raise InputError(f"slopes: {name}: dtype {array.dtype} has no plain FITS form: expected int or float")
    bits = 8 * stored.itemsize
    axes = [(f"NAXIS{axis}", length) for axis, length in enumerate(array.shape[::-1], 1)]
    header = fits.Header(
        [
            ("XTENSION", "IMAGE", "image extension"),
            ("BITPIX", -bits if stored.kind == "f" else bits),
            ("NAXIS", array.ndim),
            *axes,
            ("PCOUNT", 0),
            ("GCOUNT", 1),
            ("EXTNAME", name.upper()),
            ("BUNIT", units),
            ("COMMENT", comment),
        ]
    )
    stream.write(header.tostring().encode("ascii"))
    for piece in _pieces(array):
        stream.write(piece.astype(stored.newbyteorder(">")).tobytes())
    stream.write(bytes(-(array.size * stored.itemsize) % _FITS_BLOCK_BYTES))


def _native(array: NDArray[Any]) -> NDArray[Any]:
    return array.astype(array.dtype.newbyteorder("="))
