"""Folders and files of results, which are never seen half written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError

FORMAT = 1


def make_folder(folder: str | Path) -> Path:
    """Make a folder where it is not there, and return its path.

    Raises
    ------
    InputError
        When it cannot be made.
    """
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
    except FileNotFoundError:
        raise InputError(f"{folder}: the folder {folder.parent} does not exist: create it first") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror or error})") from None
    return folder


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is never seen half written.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None
    _written(path, lambda file: file.write(content))


def save_arrays(path: Path, values: dict[str, Any]) -> None:
    """Write arrays to a compressed NumPy file that is never seen half written.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    _written(path, lambda file: np.savez_compressed(file, **values))


def load_arrays(path: Path, what: str) -> dict[str, NDArray[Any]]:
    """Read the arrays of a NumPy file; `what` it should be is named in messages.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:  # a damaged archive raises whatever its reader meets
        raise InputError(f"{path}: not {what} ({error})".splitlines()[0]) from None


def save_fields(result: Any, path: str | Path) -> None:
    """Write all fields of a dataclass: arrays, texts, plain numbers and tuples of texts.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    values = {item.name: np.asarray(getattr(result, item.name)) for item in fields(result)}
    save_arrays(Path(path), {"format": np.asarray(FORMAT), **values})


def load_fields(kind: type[Any], path: str | Path, what: str) -> dict[str, Any]:
    """Read the fields of a dataclass that `save_fields` wrote; `what` it should be is named in messages.

    Raises
    ------
    InputError
        When it cannot be read, or is something else.
    """
    values = load_arrays(Path(path), what)
    if values.pop("format", None) != FORMAT or set(values) != {item.name for item in fields(kind)}:
        raise InputError(f"{path}: not {what} of format {FORMAT}")
    return {name: _restored(value) for name, value in values.items()}


def _written(path: Path, write: Callable[[BinaryIO], Any]) -> None:
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            write(file)
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None


def _restored(value: NDArray[Any]) -> Any:
    """Return an array as what it was: a row of texts is a tuple, what has no axes a plain number or text."""
    if value.ndim == 0:
        return value.item()
    return tuple(value.tolist()) if value.dtype.kind == "U" and value.ndim == 1 else value
