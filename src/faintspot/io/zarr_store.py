"""Zarr stores on the disk, and sizes of compressed chunks, found before a library makes room for them.

zarr alone inflates chunks of any size, takes a lost chunk for its fill value and does not wait for the disk.
"""

import bz2
import itertools
import lzma
import math
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, load_package
from faintspot.base.files import (
    MOST_TEXT_BYTES,
    check_bytes,
    check_file_size,
    read_bytes,
    replace_file,
    sync_file,
    sync_folder,
)
from faintspot.base.text_files import parse_json, to_json
from faintspot.io.stored_array import MOST_WHOLE_BYTES, one_line

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


TELEMETRY = "faintspot telemetry"
"""Format attribute of a telemetry store."""
_COMPRESSIONS = {
    "zlib": "deflate",
    "gzip": "deflate",
    **{name: name for name in ("zstd", "blosc", "lz4", "bz2", "lzma")},
}
_SPARE_BYTES = 1 << 16  # of a chunk that compression has enlarged
_MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_store(path: Path) -> bool:
    """Return whether a directory is a Zarr group or array."""
    return any((path / mark).is_file() for mark in _MARKS)


def open_store(path: Path, key: str = "") -> Any:
    """Open a group or an array of a store for reading.

    Raises
    ------
    Exception
        On broken metadata zarr raises many kinds of errors.
    """
    return load_package("zarr").open(str(path), mode="r", path=key, use_consolidated=False)


@contextmanager
def new_store(path: Path, attributes: Mapping[str, Any]) -> Iterator[Any]:
    """Create a store (format 3): fill the group in the `with` block; only then does it appear at the path."""
    hidden = path.with_name(f".{path.name}.new")
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir()
    yield load_package("zarr").create_group(str(hidden), zarr_format=3, attributes=dict(attributes))
    for file in (*hidden.rglob("*"), hidden):
        (sync_folder if file.is_dir() else sync_file)(file)
    hidden.rename(path)
    sync_folder(path.parent)


def check_array(name: str, array: Any) -> int:
    """Refuse an array of Python objects, or with too large chunks; return how often they are compressed.

    Raises
    ------
    InputError
        When the array is refused.
    """
    codecs = _codecs(array)
    if "pickle" in codecs:
        raise InputError(f"{name}: expected numbers, got Python objects, which are never unpickled")
    check_bytes(name, math.prod(array.chunks) * array.dtype.itemsize, MOST_WHOLE_BYTES, "a chunk")
    return sum(codec in _COMPRESSIONS.values() for codec in codecs)


def _codecs(array: Any) -> list[str]:
    """Return the names of the codecs of an array's chunks; compressions have those of `check_inflated`."""
    codecs = (*array.filters, *array.compressors)
    names = [str(getattr(codec, "codec_id", type(codec).__name__)) for codec in codecs]
    known = _COMPRESSIONS.items()
    return [next((codec for word, codec in known if word in name.lower()), name) for name in names]


class CheckedChunks:
    """An array of a store in a folder, whose chunks are checked before they are read."""

    def __init__(self, name: str, path: Path, array: Any) -> None:
        self._name, self._path, self._array = name, path, array
        self._sides: tuple[int, ...] = array.shards or array.chunks
        self._codec = next((codec for codec in _codecs(array) if codec in _COMPRESSIONS.values()), "")

    def __getitem__(self, part: Any) -> NDArray[Any]:
        """Return items of the first axis, or of a later one after numbers of the items of the first."""
        selection = part if isinstance(part, tuple) else (part,)
        spans = []
        for axis, (length, side) in enumerate(zip(self._array.shape, self._sides, strict=True)):
            item = selection[axis] if axis < len(selection) else slice(None)
            start, stop, _ = (slice(item, item + 1) if isinstance(item, int) else item).indices(length)
            spans.append(range(start // side, -(-stop // side)))
        for numbers in itertools.product(*spans):
            self._check(self._path / self._array.metadata.encode_chunk_key(numbers))
        return np.asarray(self._array[part])

    def _check(self, file: Path) -> None:
        """Refuse a file that is larger than its chunk, or inflates to more than a chunk may have."""
        if not file.is_file():
            return
        most = math.prod(self._sides) * self._array.dtype.itemsize
        size = check_file_size(file, "a chunk", most + most // 8 + _SPARE_BYTES)
        if self._codec and not self._array.shards and not is_surely_small(size, self._codec):
            check_inflated(self._name, file.read_bytes(), self._codec)


def stored_attributes(path: Path) -> dict[str, object]:
    """Return the attributes of a store that is a group.

    Raises
    ------
    OSError, ValueError, KeyError, TypeError
        When it is not a group of format 3.
    """
    text = read_bytes(path / "zarr.json", "metadata", MOST_TEXT_BYTES)
    attributes: dict[str, object] = parse_json(text)["attributes"]
    return attributes


def holds_telemetry(path: Path) -> bool:
    """Return whether a path is a telemetry store written by `faintspot.engine.telemetry.recorder`."""
    try:
        return bool(stored_attributes(path)["format"] == TELEMETRY)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def replace_attributes(path: Path, changed: Mapping[str, object]) -> None:
    """Replace attributes of a group in one step, which the store's own setter does not guarantee."""
    metadata = parse_json((path / "zarr.json").read_text(encoding="utf-8"))
    metadata["attributes"].update(changed)
    replace_file(path / "zarr.json", to_json(metadata, indent=2))


def checked_codecs() -> tuple[Any, ...]:
    """Return the codecs for compressed chunks with a checksum."""
    zarr = load_package("zarr")
    return zarr.codecs.ZstdCodec(level=0), zarr.codecs.Crc32cCodec()


def read_items(path: Path, array: Any, start: int, stop: int) -> NDArray[Any]:
    """Return items of an array; a missing chunk is an error here, while zarr would return its fill value.

    Raises
    ------
    InputError
        When a chunk is damaged or missing.
    """
    for number, file in enumerate(chunk_files(path, array, start, stop), start // array.chunks[0]):
        if not file.is_file():
            raise InputError(
                f"{path}: the store is damaged: {array.basename} of frame {number * array.chunks[0]} "
                "(counted from 0) and later is lost"
            )
    name = f"{path}: {array.basename}"
    check_array(name, array)
    try:
        return CheckedChunks(name, path / array.path, array)[start:stop]
    except InputError:
        raise
    except Exception as error:  # each codec raises its own kind of error on broken chunks
        raise InputError(
            f"{path}: the store is damaged: {array.basename} cannot be read ({one_line(error)})"
        ) from None


def chunk_files(path: Path, array: Any, start: int, stop: int) -> Iterator[Path]:
    """Yield the files of the chunks with items `start` to `stop`; a chunk spans all later axes."""
    length = array.chunks[0]
    rest = (0,) * (array.ndim - 1)
    numbers = range(start // length, -(-stop // length))
    return (path / array.basename / array.metadata.encode_chunk_key((number, *rest)) for number in numbers)
