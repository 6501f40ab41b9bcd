"""faintspot realtime load, swap, unload: estimators of others in a running engine."""

from __future__ import annotations

import click

from faintspot.base.errors import InputError
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.engine_requests import asked_at_length
from faintspot.cli.shared.options import ENGINE_NAME
from faintspot.engine.requests.requests import since

_FILE = click.argument("file", metavar="FILE", type=click.Path(dir_okay=False, resolve_path=True))
_USE = option("--use", is_flag=True, help="Measure with it from now on, as set estimator=NAME does.")


@click.command("load", short_help="Load an estimator from a Python file into a running engine.")
@ENGINE_NAME
@_FILE
@_USE
def load(name: str, file: str, use: bool) -> None:
    """Load the estimators that a Python file registers into a running engine.

    They are tried in a process of their own first, and refused where they fail, crash, return what they must
    not, or do not return. The file runs with all rights of the engine.

    \b
    Example:
      faintspot realtime load examples/own_estimator.py
      faintspot realtime set estimator=power power=2
    """
    _load(name, "load", file, use)


@click.command("swap", short_help="Read the edited file of a loaded estimator again.")
@ENGINE_NAME
@_FILE
@_USE
def swap(name: str, file: str, use: bool) -> None:
    """Load the estimators of a file in place of those of the same names, between two frames."""
    _load(name, "swap", file, use)


@click.command("unload", short_help="Unload an estimator from a running engine.")
@ENGINE_NAME
@click.argument("estimator")
def unload(name: str, estimator: str) -> None:
    """Unload an estimator; where it is in use, the built-in estimator before takes over."""
    frame = asked_at_length(name, "unload", estimator=estimator)["frame"]
    click.echo(f"{estimator}: unloaded{'' if frame is None else f', {since(frame)}'}")


def _load(name: str, command: str, file: str, use: bool) -> None:
    reply = asked_at_length(name, command, source=file)
    names, frame = reply["estimators"], reply["frame"]
    if use:
        if len(names) != 1:
            raise InputError(f"--use: expected one estimator in {file}, got {', '.join(names)}")
        frame = asked_at_length(name, "set", changes={"estimator": names[0]}, where=None)["frame"]
    click.echo(f"{', '.join(names)}: loaded from {file}{'' if frame is None else f', {since(frame)}'}")
