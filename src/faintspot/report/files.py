"""Files that people look at, written whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from faintspot.errors import InputError
from faintspot.io.slopes_format import output_errors


def write_file(path: str | Path, content: bytes) -> None:
    """Write a file in one step: a reader sees the old or the new one; InputError when it cannot be."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.new")
    with output_errors(path):
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist: create it or choose another")
        try:
            temporary.write_bytes(content)
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise


def write_beside(page: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write files into a folder beside a page, named as the page with "-figures"; return their paths.

    Raises
    ------
    InputError
        When the folder cannot be made or a file not written.
    """
    folder = page.with_name(f"{page.stem}-figures")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}: choose another place") from None
    for name, content in contents.items():
        write_file(folder / name, content)
    return [folder / name for name in contents]
