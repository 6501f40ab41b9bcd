"""Requirements of commands: optional packages or Linux, checked before work begins."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import click

from faintspot.base.checks import not_none
from faintspot.base.errors import MissingExtraError, present, require, require_linux


def needs(extra: str, *packages: str) -> Callable[[click.Command], click.Command]:
    """Declare which packages a command cannot do without, and the extra that installs them.

    The command then ends before any work, in one line, where one is missing; --help names the extra.
    """

    def declared(command: click.Command) -> click.Command:
        _check_first(command, lambda path: require(extra, *packages, purpose=path))
        command.epilog = f"Needs the extra `{extra}`: pip install 'faintspot[{extra}]'"
        return command

    return declared


def needs_linux(command: click.Command) -> click.Command:
    """Declare that a command does its work in real time: on Linux only."""
    _check_first(command, require_linux)
    return command


def _check_first(command: click.Command, check: Callable[[str], None]) -> None:
    """Run a check, given the command's path, before a command's work."""
    work = not_none(command.callback)

    @wraps(work)
    def checked(*arguments: object, **options: object) -> Any:
        check(click.get_current_context().command_path)
        return work(*arguments, **options)

    command.callback = checked


def can_make(what: str, extra: str, *packages: str, asked: bool = False) -> bool:
    """Tell whether a command can make a part of its output; if not, say so now, and that it is left out.

    Parameters
    ----------
    what : str
        The part, such as "picture".
    extra, packages : str
        As for `needs`.
    asked : bool
        Whether the user asked for it: then its absence is an error.
    """
    try:
        require(extra, *packages, purpose=f"A {what}")
    except MissingExtraError as error:
        if asked:
            raise
        click.echo(f"without {what}: {error}", err=True)
        return False
    return True


def suggested_slopes() -> str:
    """Return the name to suggest for a file of slopes: one that can be written here."""
    return "slopes.zarr" if present("zarr") else "slopes.npz"
