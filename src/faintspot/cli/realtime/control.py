"""faintspot realtime status, top, get, set, interleave, control and stop: requests to a running engine."""

from __future__ import annotations

from typing import Any

import click

from faintspot.base.json_text import to_json
from faintspot.cli.realtime.camera import stop_on_signal
from faintspot.cli.shared.commands import Group, option
from faintspot.cli.shared.engine_requests import (
    asked,
    asked_at_length,
    loop_in_words,
    notes,
    summary,
)
from faintspot.cli.shared.options import AS_JSON, ENGINE_NAME
from faintspot.engine.requests.requests import since

_REFRESH_S = 0.5
_LOOP_ACTIONS = {
    "open": "Open the loop: the mirror keeps its commands.",
    "close": "Close the loop, starting from the mirror's present commands.",
    "flat": "Flatten the mirror while the loop is open.",
}


@click.command("status")
@ENGINE_NAME
@AS_JSON
def status(name: str, as_json: bool) -> None:
    """Show counters, latencies and the loop of a running engine."""
    reply = asked(name, "status")
    click.echo(to_json(reply, indent=1) if as_json else summary(reply))


@click.command("get")
@ENGINE_NAME
@click.argument("settings", nargs=-1)
def get(name: str, settings: tuple[str, ...]) -> None:
    """Show settings of a running engine: all, or those named.

    Defaults are filled in; null is what is not used, or found from the PSF or each frame.
    """
    for key, value in asked(name, "get", names=list(settings) or None)["settings"].items():
        click.echo(f"{key} = {to_json(value)}")


@click.command("set", short_help="Change settings of a running engine, between two frames.")
@ENGINE_NAME
@option(
    "--subapertures", metavar="LIST", help="Sub-apertures to change, such as 4,5,10-20.", show_default="all"
)
@click.argument("changes", nargs=-1, required=True, metavar="NAME=VALUE...")
def set_settings(name: str, subapertures: str | None, changes: tuple[str, ...]) -> None:
    """Change settings of a running engine between two frames, all at once or not at all.

    The answer comes when they are in effect. Kernels that this machine has not used yet are compiled first,
    which takes up to half a minute, once; frames are measured as before meanwhile, and status says so.

    \b
    Example:
      faintspot realtime set noise_std=2.5 keep_brightest=20 --subapertures 4,5,10-20
    """
    from faintspot.base.config.written_changes import parse_changes, parse_subapertures

    where = None if subapertures is None else parse_subapertures(subapertures)
    wanted = {"changes": parse_changes(changes), "where": where}
    reply = asked_at_length(name, "set", **wanted)
    click.echo(since(reply["frame"]))


@click.command("interleave", short_help="Alternate between settings in a running engine.")
@ENGINE_NAME
@click.argument("methods")
@option("--every", type=click.IntRange(1), default=50, help="Frames for each in turn.")
def interleave(name: str, methods: str, every: int) -> None:
    """Alternate between settings in a running engine: METHODS as of run --interleave; "set" ends it.

    \b
    Example:
      faintspot realtime interleave none,tv --every 100
    """
    reply = asked_at_length(name, "interleave", methods=methods, every=every)
    click.echo(since(reply["frame"]))


@click.command("stop")
@ENGINE_NAME
def stop_engine(name: str) -> None:
    """End a running engine."""
    asked(name, "stop")


@click.command("top", short_help="Watch a running engine in the terminal.")
@ENGINE_NAME
def top(name: str) -> None:
    """Watch a running engine in the terminal; Ctrl-C ends watching."""
    from rich.live import Live

    with Live(_table(name), refresh_per_second=1 / _REFRESH_S) as live, stop_on_signal() as stop:
        while not stop.wait(_REFRESH_S):
            live.update(_table(name))


def _table(name: str) -> Any:
    """Everything that an engine says of itself, for the terminal."""
    from rich.table import Table

    reply = asked(name, "status")
    source, latency = reply["source"], reply["latency"]
    grid = Table(title=f"{name}: {reply['estimator']}", title_justify="left")
    grid.add_column("")
    grid.add_column("", justify="right")
    grid.add_row("source", "none" if source is None else f"process {source['pid']}, frame {source['frame']}")
    for title, text in notes(reply).items():
        grid.add_row(title, text, style=None if title in ("preparing", "learnt") else "bold red")
    if len(reply["methods"]) > 1:
        grid.add_row("methods", ", ".join(reply["methods"]))
    if reply["loop"]["state"] != "none":
        grid.add_row("loop", loop_in_words(reply["loop"]).removeprefix("loop "))
    for estimator, file in reply["loaded"].items():
        grid.add_row(f"{estimator} loaded from", file)
    grid.add_section()
    for key, value in reply["counters"].items():
        grid.add_row(key.replace("_", " "), f"{value}")
    slopes = reply["counters"]["processed"] * reply["subapertures"]
    mean = f"{reply['counters']['iterations'] / slopes:.1f}" if slopes else "-"
    grid.add_row("iterations a sub-aperture", mean)
    grid.add_section()
    for key in ("min", "p50", "p99", "p99_9", "max"):
        value = latency[f"{key}_us"]
        grid.add_row(f"latency {key.replace('_', '.')}, us", "-" if value is None else f"{value:.1f}")
    return grid


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
@AS_JSON
def loop_status(name: str, as_json: bool) -> None:
    """Show whether the loop is closed, and if not, why."""
    loop = asked(name, "loop", action="status")["loop"]
    click.echo(to_json(loop, indent=1) if as_json else loop_in_words(loop))


@control.command("gain")
@ENGINE_NAME
@click.argument("gain", type=float)
def gain(name: str, gain: float) -> None:
    """Change the loop gain from the next frame on."""
    click.echo(loop_in_words(asked(name, "loop", action="gain", gain=gain)["loop"]))


def _add_action(action: str, text: str) -> None:
    """Add a command that needs nothing but the engine's name."""

    @control.command(action, help=text)
    @ENGINE_NAME
    def act(name: str) -> None:
        click.echo(loop_in_words(asked(name, "loop", action=action)["loop"]))


for _action, _text in _LOOP_ACTIONS.items():
    _add_action(_action, _text)
