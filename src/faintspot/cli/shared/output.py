"""Tables, texts and pictures that commands print or write."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.console import Console
from rich.table import Table

from faintspot.base.errors import InputError
from faintspot.base.files import derived, write_atomically
from faintspot.cli.shared.needs import can_make

_WIDEST_TEXT = 110


def check_target(target: Path, overwrite: bool) -> None:
    """Refuse a file in a folder that is not there, and one that already exists."""
    if not target.absolute().parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist: create it or choose another")
    if target.exists() and not overwrite:
        raise InputError(f"{target}: already exists; --overwrite replaces its settings and keeps its layout")


def results_table(first: str, *headings: str, wraps: bool = False) -> Table:
    """Return an empty table whose columns hold numbers, but for the first one, which may wrap its texts."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, caption_justify="left")
    table.add_column(first, no_wrap=not wraps, ratio=1 if wraps else None)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


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


def picture_file(target: Path, picture: str | None, ending: str) -> Path | None:
    """Return where the picture goes; None, said now, where it cannot be drawn and was not asked for."""
    if not can_make("picture", "report", "matplotlib", asked=picture is not None):
        return None
    return Path(picture) if picture else derived(target, ending)


def write_picture(figure: Any, path: Path) -> None:
    """Write a figure as PNG."""
    from faintspot.base.report.plots import png

    write_atomically(path, png(figure))
    click.echo(f"picture: {path}")
