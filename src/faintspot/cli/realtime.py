"""faintspot realtime: the engine, its simulated camera, and talking to a running one."""

from __future__ import annotations

import json
import threading
from typing import Any

import click

from faintspot.cli.realtime_camera import camera, stop_on_signal
from faintspot.realtime.control import request
from faintspot.realtime.private_socket import socket_path

_NAME = click.option(
    "--name", default="faintspot", show_default=True, help="Of the pixel ring, the streams and the engine."
)
_REFRESH_S = 0.5


@click.group("realtime")
def command() -> None:
    """Run the slope computation in real time: pixels stream in, slopes stream out.

    \b
    In three terminals:
      faintspot realtime camera --config faintspot.toml --rate 500
      faintspot realtime run --config faintspot.toml
      faintspot realtime top
    """


command.add_command(camera)


@command.command("run")
@click.option(
    "-c", "--config", default="faintspot.toml", show_default=True, metavar="TOML", help="Configuration."
)
@_NAME
@click.option("--threads", type=click.IntRange(1), default=1, show_default=True, help="Workers.")
@click.option("--cpus", metavar="LIST", help="Processors to run on, such as 2,3 or 4-7.")
@click.option(
    "--priority",
    type=click.IntRange(0, 99),
    default=0,
    help="Of SCHED_FIFO, with locked memory. Default: the ordinary scheduler.",
)
@click.option("--frames", type=click.IntRange(1), help="Stop after so many. Default: at Ctrl-C.")
def run(config: str, name: str, threads: int, cpus: str | None, priority: int, frames: int | None) -> None:
    """Measure the frames of a pixel ring and publish their slopes until Ctrl-C.

    Frames come from the shared-memory pixel ring NAME, which a camera's process writes row by row; the
    engine waits for it, and for its return. Each group of sub-apertures is measured as soon as its last row
    is there. Slopes go out as the pyshmem streams NAME_slopes (all x, then all y, px) and NAME_details, each
    stamped with the frame's number.
    """
    from faintspot.pipeline import SlopePipeline
    from faintspot.realtime.control import ControlServer
    from faintspot.realtime.engine import Engine
    from faintspot.realtime.handlers import handlers_of
    from faintspot.realtime.live import parse_subapertures
    from faintspot.realtime.manners import real_time
    from faintspot.sensor import configuration

    layout, settings, calibration, psf, score = configuration.load_all(config)
    engine = Engine(
        name,
        lambda chosen: SlopePipeline(layout, chosen, calibration, psf=psf, score=score),
        settings,
        threads=threads,
    )
    processors = parse_subapertures(cpus) if cpus else None
    with ControlServer(socket_path(name), handlers_of(engine)), real_time(processors, priority) as refused:
        engine.refused = refused
        for line in refused:
            click.echo(f"not permitted, going on without: {line}", err=True)
        click.echo(
            f"{name}: {len(layout)} sub-apertures, estimator {settings.estimator}; waiting for frames, "
            "Ctrl-C stops"
        )
        with stop_on_signal() as stop:
            threading.Thread(target=_stop_when_set, args=(stop, engine), daemon=True).start()
            engine.run(frames)
    click.echo(_summary(engine.status()))


@command.command("status")
@_NAME
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def status(name: str, as_json: bool) -> None:
    """Say what a running engine has seen and how fast it is."""
    reply = _asked(name, "status")
    click.echo(json.dumps(reply, indent=1) if as_json else _summary(reply))


@command.command("get")
@_NAME
@click.argument("settings", nargs=-1)
def get(name: str, settings: tuple[str, ...]) -> None:
    """Show settings of a running engine: all, or those named."""
    for key, value in _asked(name, "get", names=list(settings) or None)["settings"].items():
        click.echo(f"{key} = {json.dumps(value)}")


@command.command("set")
@_NAME
@click.option("--subapertures", metavar="LIST", help="Which, such as 4,5,10-20. Default: all.")
@click.argument("changes", nargs=-1, required=True, metavar="NAME=VALUE...")
def set_settings(name: str, subapertures: str | None, changes: tuple[str, ...]) -> None:
    """Change settings of a running engine between two frames, all at once or not at all.

    \b
    Example:
      faintspot realtime set noise_std=2.5 keep_brightest=20 --subapertures 4,5,10-20
    """
    from faintspot.realtime.live import parse_changes, parse_subapertures

    where = None if subapertures is None else parse_subapertures(subapertures)
    reply = _asked(name, "set", changes=parse_changes(changes), where=where)
    frame = reply["frame"]
    click.echo("taken at the next frame" if frame is None else f"in effect from frame {frame}")


@command.command("stop")
@_NAME
def stop_engine(name: str) -> None:
    """End a running engine."""
    _asked(name, "stop")


@command.command("top")
@_NAME
def top(name: str) -> None:
    """Watch a running engine in the terminal; Ctrl-C ends watching."""
    from rich.live import Live
    from rich.table import Table

    def table() -> Table:
        reply = _asked(name, "status")
        grid = Table(title=f"{name}: estimator {reply['estimator']}", title_justify="left")
        grid.add_column("")
        grid.add_column("", justify="right")
        source = reply["source"]
        grid.add_row("source", "none" if source is None else f"pid {source['pid']}, frame {source['frame']}")
        for key, value in reply["counters"].items():
            grid.add_row(key.replace("_", " "), f"{value}")
        for key, value in reply["latency"].items():
            grid.add_row(f"latency {key}".replace("_", " "), "-" if value is None else f"{value:.4g}")
        return grid

    with Live(table(), refresh_per_second=1 / _REFRESH_S) as live, stop_on_signal() as stop:
        while not stop.wait(_REFRESH_S):
            live.update(table())


def _asked(name: str, what: str, **fields: Any) -> dict[str, Any]:
    """Ask the engine of that name."""
    return request(socket_path(name), what, **fields)


def _stop_when_set(stop: threading.Event, engine: Any) -> None:
    """Pass a signal on to the engine."""
    stop.wait()
    engine.stop()


def _summary(reply: dict[str, Any]) -> str:
    """Say in two lines how an engine is doing."""
    counters, latency = reply["counters"], reply["latency"]
    lost = counters["dropped"] + counters["skipped"]
    lines = f"{reply['name']}: {counters['processed']} frames measured, {lost} lost"
    if latency["count"]:
        lines += (
            f"\n  from the last row to the slopes: p50 {latency['p50_us']:.0f} us, "
            f"p99 {latency['p99_us']:.0f}, p99.9 {latency['p99_9_us']:.0f}, largest {latency['max_us']:.0f}"
        )
    return lines
