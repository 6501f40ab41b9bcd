"""Inflated size of compressed data, checked before a decoder allocates it."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zlib
from collections.abc import Iterator

from faintspot.base.npz import DAMAGE
from faintspot.base.sizes import check_bytes
from faintspot.io.arrays.raw import MOST_WHOLE_BYTES

_PIECE_BYTES, _ALWAYS_BYTES = 1 << 20, 1 << 26
_DEFLATE_RATIO = 1032  # largest ratio that deflate can reach
_ZSTD = b"\x28\xb5\x2f\xfd"


def check_inflated(name: str, data: bytes, most: int = MOST_WHOLE_BYTES) -> None:
    """Refuse compressed data that inflate to more than `most` bytes; recognise the format by content.

    Limits below 64 MiB are raised to that.

    Sizes stated by Zstandard and Blosc are trusted, because their decoders stop there. Other data are
    inflated piece by piece, unless deflate cannot exceed the limit. Damaged data are left to the decoder.

    Raises
    ------
    InputError
        When they inflate to more.
    """
    total, most = 0, max(most, _ALWAYS_BYTES)
    try:
        for n_bytes in _sizes(data, most):
            total += n_bytes
            if total > most:
                break
    except DAMAGE:
        return
    check_bytes(name, total, most, "a part")


def _sizes(data: bytes, most: int) -> Iterator[int]:
    """Yield the size of each piece of the content, as far as it must be known."""
    if data.startswith(_ZSTD):
        yield _zstandard(data)
    elif data[1:2] == b"\1" and int.from_bytes(data[12:16], "little") == len(data):
        yield int.from_bytes(data[4:8], "little")  # Blosc
    elif data.startswith((b"BZh", b"\xfd7zXZ")):
        with (bz2.open if data.startswith(b"B") else lzma.open)(io.BytesIO(data)) as stream:
            while piece := stream.read(_PIECE_BYTES):
                yield len(piece)
    elif len(data) * _DEFLATE_RATIO > most:
        if data.startswith(b"\x1f\x8b"):
            with gzip.open(io.BytesIO(data)) as stream:
                while piece := stream.read(_PIECE_BYTES):
                    yield len(piece)
        elif data[0] & 15 == 8 and int.from_bytes(data[:2], "big") % 31 == 0:
            inflater = zlib.decompressobj()
            while data and not inflater.eof:
                yield len(inflater.decompress(data, _PIECE_BYTES))
                data = inflater.unconsumed_tail


def _zstandard(data: bytes) -> int:
    """Return the content size of a Zstandard frame (RFC 8878, section 3.1.1.1), 0 if it is not stated."""
    described = data[4] if len(data) > 4 else 0
    single = described >> 5 & 1
    length = (single, 2, 4, 8)[described >> 6]
    start = 5 + (1 - single) + (0, 1, 2, 4)[described & 3]
    return int.from_bytes(data[start : start + length], "little") + (256 if length == 2 else 0)
