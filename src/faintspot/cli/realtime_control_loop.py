"""faintspot realtime control: opening and closing the loop of a running engine."""

from __future__ import annotations

import json
from typing import Any

import click

from faintspot.cli.commands import Group, option
from faintspot.cli.realtime_control import loop_in_words
from faintspot.cli.shared_options import ENGINE_NAME
from faintspot.realtime.control import request
from faintspot.realtime.private_socket import socket_path


@click.group("control", cls=Group, short_help="Open or close the loop of a running engine.")
def control() -> None:
    """Open or close the loop of a running engine, whose configuration has [control].

    While it is open, the mirror keeps its commands. A guard opens it when the slopes diverge or too many are
    not valid; status says why.

    \b
    Examples:
      faintspot realtime control close
      faintspot realtime control gain 0.3
    """


@control.command("status")
@ENGINE_NAME
@option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def status(name: str, as_json: bool) -> None:
    """Show whether the loop is closed, and if not, why."""
    reply = _asked(name, "status")
    click.echo(json.dumps(reply, indent=1) if as_json else loop_in_words(reply))


@control.command("open")
@ENGINE_NAME
def open_loop(name: str) -> None:
    """Open the loop: the mirror keeps its commands."""
    click.echo(loop_in_words(_asked(name, "open")))


@control.command("close")
@ENGINE_NAME
def close_loop(name: str) -> None:
    """Close the loop, starting from the mirror's present commands."""
    click.echo(loop_in_words(_asked(name, "close")))


@control.command("flat")
@ENGINE_NAME
def flat(name: str) -> None:
    """Flatten the mirror while the loop is open."""
    click.echo(loop_in_words(_asked(name, "flat")))


@control.command("gain")
@ENGINE_NAME
@click.argument("gain", type=float)
def gain(name: str, gain: float) -> None:
    """Change the loop gain from the next frame on."""
    click.echo(loop_in_words(_asked(name, "gain", gain=gain)))


def _asked(name: str, action: str, **fields: Any) -> dict[str, Any]:
    """Ask the engine of that name; return what it says of its loop."""
    loop: dict[str, Any] = request(socket_path(name), "loop", action=action, **fields)["loop"]
    return loop
