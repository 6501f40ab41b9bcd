"""Zarr stores on the disk: opening, checks, codecs and lost chunks."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import read_bytes, replace_file, sync_file, sync_folder
from faintspot.base.json_text import parse_json, to_json
from faintspot.base.sizes import MOST_TEXT_BYTES, check_bytes
from faintspot.io.arrays.stored_array import MOST_WHOLE_BYTES
from faintspot.io.locations import one_line
from faintspot.io.optional_packages import load_zarr

TELEMETRY = "faintspot telemetry"
"""Format attribute of a telemetry store."""
_COMPRESSIONS = "zlib", "gzip", "zstd", "blosc", "lz4", "bz2", "lzma"
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
    return load_zarr().open(str(path), mode="r", path=key, use_consolidated=False)


@contextmanager
def new_store(path: Path, attributes: Mapping[str, Any]) -> Iterator[Any]:
    """Create a store (format 3): fill the group in the `with` block; only then does it appear at the path."""
    hidden = path.with_name(f".{path.name}.new")
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir()
    yield load_zarr().create_group(str(hidden), zarr_format=3, attributes=dict(attributes))
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
    codecs = [
        getattr(codec, "codec_id", type(codec).__name__) for codec in (*array.filters, *array.compressors)
    ]
    if "pickle" in codecs:
        raise InputError(f"{name}: expected numbers, got Python objects, which are never unpickled")
    check_bytes(name, math.prod(array.chunks) * array.dtype.itemsize, MOST_WHOLE_BYTES, "a chunk")
    return sum(any(word in str(codec).lower() for word in _COMPRESSIONS) for codec in codecs)


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
    """Return whether a path is a telemetry store written by `faintspot.io.telemetry.writing`."""
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
    zarr = load_zarr()
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
    check_array(f"{path}: {array.basename}", array)
    try:
        return np.asarray(array[start:stop])
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
