"""Sizes of compressed chunks, found before a library makes room for what they inflate to."""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Callable
from typing import Any

from faintspot.base.errors import InputError
from faintspot.io.arrays.stored_array import MOST_WHOLE_BYTES

_PIECE_BYTES, _MOST_BLOCK_BYTES = 1 << 20, 1 << 17  # inflated at once; of a block of zstd
_DEFLATED = 1032  # largest ratio
_ZSTD = b"\x28\xb5\x2f\xfd"


def is_surely_small(size: int, codec: str) -> bool:
    """Return whether so many bytes cannot inflate to more than the limit."""
    return codec == "deflate" and size <= MOST_WHOLE_BYTES // _DEFLATED


def check_inflated(name: str, content: bytes, codec: str) -> None:
    """Refuse a chunk that inflates to more than the largest one that is read.

    Parameters
    ----------
    name : str
    content : bytes
    codec : str
        "deflate" (zlib or gzip), "bz2", "lzma", "zstd", "blosc", "lz4", "szip" or "hdf5-lz4", which states
        its size in eight bytes; others are not checked.

    Raises
    ------
    InputError
        If it inflates to more.
    """
    if codec in _DECODERS:
        inflated = _streamed(content, _DECODERS[codec])
    elif codec == "zstd":
        inflated = _of_zstd(content)
    else:
        first, last, order = _STATED.get(codec, (0, 0, "little"))
        inflated = int.from_bytes(content[first:last], order)
    if inflated > MOST_WHOLE_BYTES:
        raise InputError(f"{name}: damaged: a chunk inflates to more than {MOST_WHOLE_BYTES >> 20:,} MiB")


_DECODERS: dict[str, Callable[[], Any]] = {
    "deflate": lambda: zlib.decompressobj(zlib.MAX_WBITS | 32),
    "bz2": bz2.BZ2Decompressor,
    "lzma": lzma.LZMADecompressor,
}
# Place of the size that a chunk states.
_STATED: dict[str, tuple[int, int, Any]] = {
    "blosc": (4, 8, "little"),
    "lz4": (0, 4, "little"),
    "szip": (0, 4, "little"),
    "hdf5-lz4": (0, 8, "big"),
}


def _streamed(content: bytes, new_decoder: Callable[[], Any]) -> int:
    """Inflate piece by piece, to little more than the limit; return the size."""
    decoder, total = new_decoder(), 0
    while total <= MOST_WHOLE_BYTES:
        piece = decoder.decompress(content, _PIECE_BYTES)
        total += len(piece)
        content = getattr(decoder, "unconsumed_tail", b"")  # the other decoders keep it
        if decoder.eof and decoder.unused_data[:2] in (b"\x1f\x8b", b"BZ", b"\xfd7"):
            content, decoder = decoder.unused_data, new_decoder()
        elif decoder.eof or not (piece or content):
            break
    return total


def _of_zstd(content: bytes) -> int:
    """Return the sum of the sizes that frames state, or that their blocks have at most."""
    at = total = 0
    while content[at : at + 4] == _ZSTD:
        described = content[at + 4]
        is_single = described >> 5 & 1
        at += 6 - is_single + (0, 1, 2, 4)[described & 3]
        n_bytes = (is_single, 2, 4, 8)[described >> 6]
        stated = int.from_bytes(content[at : at + n_bytes], "little") + 256 * (n_bytes == 2)
        at, most, is_last = at + n_bytes, 0, 0
        while not is_last and at + 3 <= len(content):
            block = int.from_bytes(content[at : at + 3], "little")
            is_last, kind, size = block & 1, block >> 1 & 3, block >> 3
            most += size if kind < 2 else _MOST_BLOCK_BYTES
            at += 3 + (1 if kind == 1 else size)
        at += 4 * (described >> 2 & 1)
        total += stated if n_bytes else most
    return total
