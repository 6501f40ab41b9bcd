"""faintspot realtime load, swap, unload, modules: algorithms of others in a running engine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from faintspot.cli.engine_requests import asked_at_length
from faintspot.cli.shared_options import ENGINE_NAME

_ISOLATE = click.option(
    "--isolate", is_flag=True, help="Run it in a process of its own: 60 us a frame or more."
)


@click.command("load")
@ENGINE_NAME
@_ISOLATE
@click.argument("module", metavar="NAME_OR_PATH")
def load(name: str, module: str, isolate: bool) -> None:
    """Put a module in place of a stage of a running engine.

    A module is a Python file, or one that is installed under that name, which replaces one of the stages
    calibrate, denoise, background and centroid. It is tried in a process of its own, and refused where it
    fails, crashes, does not return what it must, or takes too long. It runs with all rights of the engine.
    With --isolate, what crashes later, or never returns, does not take the engine along.

    \b
    Example:
      faintspot realtime load examples/median_module.py
    """
    _show(asked_at_length(name, "load", source=_source(module), isolate=isolate))


@click.command("swap", short_help="Put a module in the place of the one that is loaded.")
@ENGINE_NAME
@_ISOLATE
@click.argument("module", metavar="NAME_OR_PATH")
def swap(name: str, module: str, isolate: bool) -> None:
    """Put a module in the place of the one that is loaded in its stage, between two frames.

    A file is read anew: this also takes a changed version of a file that is loaded.
    """
    _show(asked_at_length(name, "swap", source=_source(module), isolate=isolate))


@click.command("unload")
@ENGINE_NAME
@click.argument("stage", metavar="STAGE_OR_NAME")
def unload(name: str, stage: str) -> None:
    """Put a built-in stage back in place of a module."""
    reply = asked_at_length(name, "unload", stage=stage)
    click.echo(f"{reply['stage']}: the built-in stage, {_since(reply['frame'])}")


@click.command("modules", short_help="List the modules that are installed and loaded.")
@ENGINE_NAME
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def modules(name: str, as_json: bool) -> None:
    """List the modules that are installed and loaded, and the last fault."""
    reply = asked_at_length(name, "modules")
    if as_json:
        click.echo(json.dumps(reply, indent=1))
        return
    for module in reply["loaded"]:
        click.echo(f"loaded     {_line(module)}")
    for installed, value in reply["installed"].items():
        click.echo(f"installed  {installed} ({value})")
    if not reply["loaded"] and not reply["installed"]:
        click.echo("no module is loaded, none is installed; faintspot realtime load takes a Python file")
    if reply["fault"]:
        click.echo(f"fault      {reply['fault']}")


COMMANDS = (load, swap, unload, modules)


def _source(name_or_path: str) -> str:
    """A path as the engine finds it, whose working directory is another one; a name as it is."""
    is_path = name_or_path.endswith(".py") or "/" in name_or_path
    return str(Path(name_or_path).expanduser().resolve()) if is_path else name_or_path


def _show(reply: dict[str, Any]) -> None:
    click.echo(f"{_line(reply['module'])}: {_since(reply['frame'])}")


def _line(module: dict[str, Any]) -> str:
    where = ", in a process of its own" if module["isolated"] else ""
    return f"{module['stage']}: {module['name']} ({module['source']}, {module['digest'][:12]}){where}"


def _since(frame: int | None) -> str:
    return "taken at the next frame" if frame is None else f"in effect from frame {frame}"
