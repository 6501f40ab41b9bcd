"""Slopes in FITS files, written in parts, with checksums (FITS standard 4.0, section 4.4.2.7)."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import parse_json
from faintspot.io.arrays.raw import open_plain_or_gzip, pieces
from faintspot.io.optional_packages import load_fits
from faintspot.io.stored.slopes_format import COORDINATE_UNITS, VARIABLES, StoredSlopes, unit_of, with_absent

fits = load_fits()
_BLOCK_BYTES = 2880
_PIECE_BYTES = 1 << 20
_NO_CHECKSUM = "0" * 16
# Characters between digits, capitals and small letters, which a checksum must not contain.
_NOT_ALLOWED = frozenset(range(0x3A, 0x41)) | frozenset(range(0x5B, 0x61))


def write_fits(stream: IO[bytes], slopes: StoredSlopes) -> None:
    """Write an image extension for each variable and coordinate, and ATTRIBUTES: a JSON text as bytes."""
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
    _write_header(stream, primary, 0)
    for name, array in slopes.variables.items():
        _write_image(stream, name, array, unit_of(name, slopes.attributes), VARIABLES[name].long_name)
    for name, array in slopes.coordinates.items():
        _write_image(stream, name, array, COORDINATE_UNITS.get(name, "1"), "of each sub-aperture")
    text = np.frombuffer(json.dumps(dict(slopes.attributes)).encode(), np.uint8)
    _write_image(stream, "attributes", text, "1", "JSON text, UTF-8")


def read_fits(path: Path) -> StoredSlopes:
    """Read a FITS file of slopes with its checksums."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # astropy only warns of truncated files and wrong checksums
        try:
            with open_plain_or_gzip(path) as stream, fits.open(stream, memmap=False, checksum=True) as units:
                arrays = {unit.name.lower(): _native(unit.data) for unit in units[1:]}
                while stream.read(_PIECE_BYTES):
                    pass  # gzip verifies its checksum only at its end
        except Warning as warning:
            raise ValueError(str(warning)) from None
    stored = {name: arrays.pop(name).astype(VARIABLES[name].dtype) for name in VARIABLES if name in arrays}
    variables = with_absent(stored)
    attributes = parse_json(arrays.pop("attributes").tobytes())
    return StoredSlopes(variables, arrays, attributes, True, len(variables["x"]))


def _write_image(stream: IO[bytes], name: str, array: NDArray[Any], units: str, comment: str) -> None:
    """Write one image extension; FITS stores big-endian numbers and bool as bytes."""
    stored = array.dtype if array.dtype != np.bool_ else np.dtype(np.uint8)
    if stored.kind == "u" and stored.itemsize > 1:
        raise InputError(f"slopes: {name}: dtype {array.dtype} is not supported, expected int or float")
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

    def big_endian() -> Iterator[bytes]:
        for piece in pieces(array):
            yield piece.astype(stored.newbyteorder(">")).tobytes()

    _write_header(stream, header, _sum(big_endian()))
    for piece in big_endian():
        stream.write(piece)
    stream.write(bytes(-(array.size * stored.itemsize) % _BLOCK_BYTES))


def _write_header(stream: IO[bytes], header: Any, data_sum: int) -> None:
    """Write a header with the checksum of its data, and the value that completes the total to all ones."""
    header["CHECKSUM"] = _NO_CHECKSUM
    header["DATASUM"] = str(data_sum)
    total = _sum([header.tostring().encode("ascii")], data_sum)
    header["CHECKSUM"] = _encoded(~total & 0xFFFFFFFF)
    stream.write(header.tostring().encode("ascii"))


def _sum(content: Iterator[bytes] | list[bytes], start: int = 0) -> int:
    """Return the ones' complement sum of big-endian 32-bit words: overflow is added at the low end."""
    total, rest = start, b""
    for piece in content:
        joined = rest + piece
        whole = len(joined) // 4 * 4
        total += int(np.frombuffer(joined[:whole], ">u4").sum(dtype=np.uint64))
        rest = joined[whole:]
    total += int.from_bytes(rest.ljust(4, b"\0"), "big")
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def _encoded(number: int) -> str:
    """Return 16 letters and digits that add `number` to the header's sum, relative to zeros.

    Each byte of the number is shared among four characters, one word apart. A character that is neither
    letter nor digit passes one on to its neighbour until both are. The value of a card starts one character
    before a word boundary, so the last character comes first.
    """
    columns = []
    for byte in number.to_bytes(4, "big"):
        share, left = divmod(byte, 4)
        codes = [ord("0") + share] * 4
        codes[0] += left
        for one in (0, 2):
            while _NOT_ALLOWED & {codes[one], codes[one + 1]}:
                codes[one] += 1
                codes[one + 1] -= 1
        columns.append(codes)
    text = "".join(chr(columns[byte][word]) for word in range(4) for byte in range(4))
    return text[-1] + text[:-1]


def _native(array: NDArray[Any]) -> NDArray[Any]:
    return array.astype(array.dtype.newbyteorder("="))
