"""faintspot realtime loop: opening and closing the loop of a running engine."""

from __future__ import annotations

import json
from typing import Any

import click

from faintspot.cli.realtime_control import loop_in_words
from faintspot.cli.shared_options import ENGINE_NAME
from faintspot.realtime.control import request
from faintspot.realtime.private_socket import socket_path


@click.group("loop", short_help="Open or close the loop of a running engine.")
def loop() -> None:
    """Open or close the loop of a running engine, whose configuration has [control].

    While it is open, the mirror keeps what it has. A guard opens it when the slopes diverge or too many are
    not valid; status says why.

    \b
    Example:
      faintspot realtime loop close
      faintspot realtime loop gain 0.3
    """


@loop.command("status")
@ENGINE_NAME
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def status(name: str, as_json: bool) -> None:
    """Say whether it is closed, and if not, why."""
    reply = _asked(name, "status")
    click.echo(json.dumps(reply, indent=1) if as_json else loop_in_words(reply))


@loop.command("open")
@ENGINE_NAME
def open_loop(name: str) -> None:
    """Open it: the mirror keeps what it has."""
    click.echo(loop_in_words(_asked(name, "open")))


@loop.command("close")
@ENGINE_NAME
def close_loop(name: str) -> None:
    """Close it, from what the mirror has on."""
    click.echo(loop_in_words(_asked(name, "close")))


@loop.command("flat")
@ENGINE_NAME
def flat(name: str) -> None:
    """Have the mirror flat, while the loop is open."""
    click.echo(loop_in_words(_asked(name, "flat")))


@loop.command("gain")
@ENGINE_NAME
@click.argument("gain", type=float)
def gain(name: str, gain: float) -> None:
    """Change the loop gain from the next frame on."""
    click.echo(loop_in_words(_asked(name, "gain", gain=gain)))


def _asked(name: str, action: str, **fields: Any) -> dict[str, Any]:
    """Ask the engine of that name; return what it says of its loop."""
    loop: dict[str, Any] = request(socket_path(name), "loop", action=action, **fields)["loop"]
    return loop
