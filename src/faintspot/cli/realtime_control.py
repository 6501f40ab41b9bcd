"""faintspot realtime status, get, set, stop, top: talking to a running engine."""

from __future__ import annotations

import json
from typing import Any

import click

from faintspot.cli.commands import option
from faintspot.cli.engine_requests import asked_at_length
from faintspot.cli.realtime_camera import stop_on_signal
from faintspot.cli.shared_options import ENGINE_NAME
from faintspot.realtime.control import request
from faintspot.realtime.private_socket import socket_path

_REFRESH_S = 0.5


@click.command("status")
@ENGINE_NAME
@option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def status(name: str, as_json: bool) -> None:
    """Show counters, latencies and the loop of a running engine."""
    reply = _asked(name, "status")
    click.echo(json.dumps(reply, indent=1) if as_json else summary(reply))


@click.command("get")
@ENGINE_NAME
@click.argument("settings", nargs=-1)
def get(name: str, settings: tuple[str, ...]) -> None:
    """Show settings of a running engine: all, or those named.

    Defaults are filled in; null is what is not used, or found from the PSF or each frame.
    """
    for key, value in _asked(name, "get", names=list(settings) or None)["settings"].items():
        click.echo(f"{key} = {json.dumps(value)}")


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
    from faintspot.config.written_changes import parse_changes, parse_subapertures

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
    reply = asked_at_length(name, "interleave", arms=methods, every=every)
    click.echo(since(reply["frame"]))


@click.command("stop")
@ENGINE_NAME
def stop_engine(name: str) -> None:
    """End a running engine."""
    _asked(name, "stop")


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

    reply = _asked(name, "status")
    source, latency = reply["source"], reply["latency"]
    grid = Table(title=f"{name}: {reply['estimator']}", title_justify="left")
    grid.add_column("")
    grid.add_column("", justify="right")
    grid.add_row("source", "none" if source is None else f"process {source['pid']}, frame {source['frame']}")
    for words in ("source_refused", "estimator_fault"):
        if reply[words]:
            grid.add_row(words.replace("_", " "), f"[bold red]{reply[words]}")
    if len(reply["arms"]) > 1:
        grid.add_row("arms in turn", ", ".join(reply["arms"]))
    if reply["preparing"]:
        grid.add_row("preparing", _preparing(reply["preparing"]))
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


def since(frame: int | None) -> str:
    """Describe from which frame on a change is in effect."""
    return "taken at the next frame" if frame is None else f"in effect from frame {frame}"


def _asked(name: str, what: str, **fields: Any) -> dict[str, Any]:
    """Ask the engine of that name."""
    return request(socket_path(name), what, **fields)


def _preparing(change: dict[str, Any]) -> str:
    return f"{', '.join(change['changes'])} (for {change['seconds']:.0f} s)"


def loop_in_words(loop: dict[str, Any]) -> str:
    """Describe the state of a loop."""
    if loop["state"] == "none":
        return "no loop: the engine makes no commands"
    gain = "" if loop["gain"] is None else f", gain {loop['gain']:g}"
    text = f"loop {loop['state']}: {loop['controller']}{gain}"
    if loop["obstacle"]:
        return f"{text}; {loop['obstacle']}"
    if loop["opened_because"]:
        return f"{text}; {loop['opened_because']}"
    return f"{text}, slopes of {loop['residual_px']:.2f} px rms"


def summary(reply: dict[str, Any]) -> str:
    """Summarise the counters and latencies of an engine."""
    counters, latency = reply["counters"], reply["latency"]
    lost = counters["dropped"] + counters["skipped"]
    lines = f"{reply['name']}: {counters['processed']} frames measured, {lost} lost, {counters['late']} late"
    for words in ("source_refused", "estimator_fault"):
        if reply[words]:
            lines += f"\n  {words.replace('_', ' ')}: {reply[words]}"
    if reply["preparing"]:
        lines += f"\n  preparing: {_preparing(reply['preparing'])}"
    if reply["loop"]["state"] != "none":
        lines += f"\n  {loop_in_words(reply['loop'])}"
    if latency["count"]:
        lines += (
            f"\n  from the last row to the slopes: p50 {latency['p50_us']:.0f} us, "
            f"p99 {latency['p99_us']:.0f}, p99.9 {latency['p99_9_us']:.0f}, largest {latency['max_us']:.0f}"
        )
    return lines
