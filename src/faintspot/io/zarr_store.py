"""What a Zarr store is on the disk."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.files import parse_json, replace_file
from faintspot.io.locations import one_line
from faintspot.io.optional_packages import load_zarr

TELEMETRY = "faintspot telemetry"
"""What a store of telemetry has as its format."""
_MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_store(path: Path) -> bool:
    """Tell whether a directory is a Zarr group or array."""
    return any((path / mark).is_file() for mark in _MARKS)


def holds_telemetry(path: Path) -> bool:
    """Tell whether a path is a store of telemetry, as `faintspot.io.telemetry` writes it."""
    try:
        attributes = parse_json((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        return bool(attributes["format"] == TELEMETRY)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def replace_attributes(path: Path, changed: Mapping[str, Any]) -> None:
    """Change attributes of a group in one step, which the store's own setter does not promise."""
    metadata = parse_json((path / "zarr.json").read_text(encoding="utf-8"))
    metadata["attributes"].update(changed)
    replace_file(path / "zarr.json", json.dumps(metadata, indent=2))


def checked_codecs() -> tuple[Any, ...]:
    """Return the codecs of a chunk that is compressed and has a checksum."""
    zarr = load_zarr()
    return zarr.codecs.ZstdCodec(level=0), zarr.codecs.Crc32cCodec()


def read_items(path: Path, array: Any, start: int, stop: int, *, whole: bool) -> NDArray[Any]:
    """Return items of an array, or say that some are lost: to Zarr, a lost chunk is its fill value.

    `whole` says that a store without checksums has all chunks, too; one with checksums always does.

    Raises
    ------
    InputError
        When a chunk is damaged or lost.
    """
    zarr = load_zarr()
    if whole or any(isinstance(codec, zarr.codecs.Crc32cCodec) for codec in array.compressors):
        for number, file in enumerate(chunk_files(path, array, start, stop), start // array.chunks[0]):
            if not file.is_file():
                raise InputError(
                    f"{path}: the store is damaged: {array.basename} of frame {number * array.chunks[0]} "
                    "(counted from 0) and later is lost"
                )
    try:
        return np.asarray(array[start:stop])
    except Exception as error:  # a broken chunk makes each codec raise its own kind
        raise InputError(
            f"{path}: the store is damaged: {array.basename} cannot be read ({one_line(error)})"
        ) from None


def chunk_files(path: Path, array: Any, start: int, stop: int) -> Iterator[Path]:
    """Yield the files of the chunks that hold items `start` to `stop`; a chunk spans all later axes."""
    length = array.chunks[0]
    rest = (0,) * (array.ndim - 1)
    numbers = range(start // length, -(-stop // length))
    return (path / array.basename / array.metadata.encode_chunk_key((number, *rest)) for number in numbers)
