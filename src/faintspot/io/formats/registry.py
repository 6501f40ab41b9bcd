"""Formats of files: the subclasses of `FileFormat` in the modules of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from faintspot.base.errors import InputError, import_modules
from faintspot.base.files import check_regular
from faintspot.io.file_format import FileFormat

import_modules(__name__.rpartition(".")[0])


def _below(kind: type[FileFormat]) -> Iterator[type[FileFormat]]:
    for below in kind.__subclasses__():
        yield below
        yield from _below(below)


FORMATS: tuple[FileFormat, ...] = tuple(
    kind() for kind in _below(FileFormat) if not kind.__name__.startswith("_")
)
_SIGNATURE_BYTES = 8


def frame_format(path: Path) -> FileFormat:
    """Return the format of a file of frames, recognised by content.

    Raises
    ------
    InputError
        When it has no known format.
    OSError
        When it cannot be read.
    """
    start = b""
    if not path.is_dir():
        check_regular(path)
        with path.open("rb") as stream:
            start = stream.read(_SIGNATURE_BYTES)
        if not start:
            raise InputError(f"{path}: expected frames, the file is empty")
    for item in FORMATS:
        if item.has_frames(path, start):
            return item
    names = list(dict.fromkeys(item.name for item in FORMATS if item.signatures))
    raise InputError(
        f"{path}: expected a {_listed(names)} file, a text (.csv, .txt, .dat) or a Zarr store, it is none of "
        "them"
    )


def slope_format(path: Path) -> FileFormat:
    """Return the format of a file of slopes, by the ending of its name.

    Raises
    ------
    InputError
        When the ending is unknown.
    """
    for item in FORMATS:
        if path.name.lower().endswith(item.endings):
            return item
    raise InputError(f"{path}: expected a name ending in {_listed(slope_endings())}")


def slope_endings() -> list[str]:
    """Return all endings of files of slopes."""
    return [ending for item in FORMATS for ending in item.endings]


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"
