"""Output that `faintspot tune` and `faintspot loop tune` share."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from faintspot.base.errors import InputError
from faintspot.base.files import derived, write_atomically
from faintspot.cli.needs import can_make

_WIDEST_TEXT = 110


def check_target(target: Path, overwrite: bool) -> None:
    """Refuse a file in a folder that is not there, and one that is there already."""
    if not target.absolute().parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist: create it or choose another")
    if target.exists() and not overwrite:
        raise InputError(f"{target}: exists already; --overwrite replaces its settings and keeps its layout")


def wrapped(lines: list[str], console: Console, indent: str = "") -> list[str]:
    """Return lines that fit the terminal."""
    width = min(console.width, _WIDEST_TEXT)
    return [
        part
        for line in lines
        for part in textwrap.wrap(
            line, width, initial_indent=indent, subsequent_indent=f"{indent}  ", break_long_words=False
        )
    ]


def picture_file(target: Path, picture: str | None) -> Path | None:
    """Return where the picture goes; None, said now, where it cannot be drawn and was not asked for."""
    if not can_make("picture", "web", "matplotlib", asked=picture is not None):
        return None
    return Path(picture) if picture else derived(target, "-tune.png")


def write_picture(figure: Any, path: Path) -> None:
    """Write a figure as PNG."""
    from faintspot.report.drawing import png

    write_atomically(path, png(figure))
    click.echo(f"{path}: picture")
