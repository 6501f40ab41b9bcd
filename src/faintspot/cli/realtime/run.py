"""faintspot realtime run, and live: the engine itself, and a web page of it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import require, require_linux
from faintspot.cli.commands import (
    ENGINE_NAME,
    FRAMES,
    PORT,
    RANGES,
    configuration_option,
    name_option,
    needs,
    option,
)
from faintspot.cli.realtime.engine_requests import stop_on_signal, summary
from faintspot.engine.processes.requests import socket_path

if TYPE_CHECKING:
    from faintspot.engine.engine import Engine
    from faintspot.engine.page.server import LiveServer
    from faintspot.engine.streams.bridge import StreamBridge


_NICENESS = 5  # the engine comes first


@needs("realtime", "tornado", "pyshmem", "zarr")
@click.command()
@ENGINE_NAME
@option("--bind", default="127.0.0.1", metavar="ADDRESS", help="Address of this machine to listen on.")
@PORT
@option("--private", is_flag=True, help="Watching needs the token also on this machine.")
@option(
    "--output",
    "-o",
    "folder",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    default=".",
    help="Folder for recordings that the page begins.",
    metavar="FOLDER",
)
def live(name: str, bind: str, port: int, private: bool, folder: Path) -> None:
    """Serve a web page of the running engine NAME until Ctrl-C.

    The page shows frames, slopes, flux, validity, latencies and alternating methods. The printed address
    allows settings to be changed; without its part from # on, a browser on this machine may only watch. The
    page reads telemetry as a recorder does, so the engine never waits for it.

    \b
    Examples:
      faintspot live
      faintspot live --port 8700
    """
    from faintspot.engine.page.server import serve
    from faintspot.engine.processes.child_processes import low_priority

    require_linux("live")
    low_priority(_NICENESS)
    with stop_on_signal() as stop:
        serve(name, stop, _say, address=bind, port=port, private=private, folder=folder)


@contextmanager
def page_beside(name: str) -> Iterator[None]:
    """Serve the page of an engine in a process of its own, which ends with this one's work."""
    require("realtime", "tornado", purpose="--live")
    process = subprocess.Popen([sys.executable, "-m", "faintspot", "live", "--name", name])
    try:
        yield
    finally:
        process.terminate()  # harmless where Ctrl-C has ended it already
        process.wait()


def _say(server: LiveServer) -> None:
    """Print where the page is."""
    click.echo(f"{server.url}\nOpen it in a browser; Ctrl-C ends it")


@needs("realtime", "pyshmem")
@click.command("run", short_help="Measure frames as they arrive and publish their slopes.")
@configuration_option("Configuration.")
@name_option("Name of the pixel ring, the streams and the engine.")
@option("--stream", metavar="NAME", help="Take whole frames from a stream: pyshmem's, or isio:NAME.")
@option("--threads", type=click.IntRange(1), default=1, help="Worker threads.")
@option("--cpus", type=RANGES, metavar="LIST", help="Processors to run on, such as 2,3 or 4-7.")
@option(
    "--priority",
    type=click.IntRange(0, 99),
    default=0,
    help="Priority of SCHED_FIFO, with locked memory.",
    show_default="the ordinary scheduler",
)
@option(
    "--poll",
    "polls",
    is_flag=True,
    help="Poll for rows all the time, on processors that nobody else uses; see the guide.",
)
@option(
    "--interleave",
    metavar="METHODS",
    help="Alternate between settings, strengths or controllers, such as none,tv:0.6,tv:0.8 or "
    "integrator,kalman.",
)
@option("--every", type=click.IntRange(1), default=50, help="Frames for each in turn.")
@option(
    "--deadline-us",
    metavar="US",
    type=click.FloatRange(0, min_open=True),
    default=1000.0,
    help="Latency limit after the last row, above which slopes count as late.",
)
@option(
    "--images-every",
    type=click.IntRange(0),
    default=100,
    help="Telemetry keeps the images of every N-th frame; 0: of none.",
)
@option("--close-loop", is_flag=True, help="Close the loop with the first frame.")
@option("--no-control", is_flag=True, help="Compute no commands, although the configuration has [control].")
@option(
    "--flux-frames",
    "mean_flux",
    type=click.FloatRange(1),
    metavar="FRAMES",
    help="Give estimators the flux of every sub-aperture, averaged over this number of frames.",
)
@FRAMES
@option("--live", is_flag=True, help="Serve the web page as well: faintspot live.")
def run(
    config: str,
    name: str,
    stream: str | None,
    cpus: list[int] | None,
    priority: int,
    interleave: str | None,
    every: int,
    deadline_us: float,
    close_loop: bool,
    no_control: bool,
    frames: int | None,
    live: bool,
    **options: Any,
) -> None:
    """Measure the frames of a pixel ring and publish their slopes until Ctrl-C.

    Frames come from the shared-memory pixel ring NAME, which a camera's process writes row by row, or whole
    from another program's stream; the engine waits for it, and for its return. Each group of sub-apertures
    is measured as soon as its last row is there. Slopes go out as the pyshmem streams NAME_slopes (all x,
    then all y, px), NAME_details and NAME_marks, each stamped with the frame's number; `faintspot realtime
    record` keeps them. Where the configuration has [control], commands follow from them as NAME_commands.

    \b
    On sky, with and without, 50 frames each (NAME_marks says which):
      faintspot realtime run --close-loop --interleave none,tv:0.6,tv:0.8 --every 50
      faintspot realtime run --close-loop --interleave integrator,kalman --every 250
    """
    from faintspot.base.errors import InputError
    from faintspot.engine.engine import Engine
    from faintspot.engine.frames.workers import PipelineMaker
    from faintspot.engine.processes.child_processes import real_time
    from faintspot.engine.processes.requests import ControlServer
    from faintspot.engine.request_handlers import LENGTHY, commands_of, while_starting
    from faintspot.engine.settings.interleaving import Interleaving
    from faintspot.engine.settings.plan import EngineOptions
    from faintspot.loop.control.configuration import load_control
    from faintspot.slopes.pipeline.configuration import Configuration

    described = Configuration(config)
    layout, settings = described.layout, described.settings
    control = None if no_control else load_control(described)
    if close_loop and control is None:
        raise InputError(f"--close-loop: expected [control] in {config}, which says what makes commands")
    reference = None if control is None else control.reference
    handlers = while_starting()
    with ControlServer(socket_path(name), handlers, lengthy=LENGTHY):  # answers while the engine compiles
        engine = Engine(
            name,
            PipelineMaker(layout, described.calibration, reference=reference, **described.spot),
            settings,
            EngineOptions(cpus=cpus, deadline_s=deadline_us * 1e-6, **options),
            source=None if stream is None else _followed(stream, name),
            interleaving=None if interleave is None else Interleaving.parse(interleave, every),
            control=control,
        )
        handlers.update(commands_of(engine))
        if engine.loop is not None and close_loop:
            engine.loop.close()
        learns = nullcontext() if interleave else _learning(engine, config)
        page = page_beside(name) if live else nullcontext()
        # Processes beside the engine start first: otherwise they would have its processors and priority.
        with stop_on_signal() as stop, learns, page, real_time(cpus, priority) as refused:
            engine.refused = refused
            for line in refused:
                click.echo(f"not permitted, going on without: {line}", err=True)
            click.echo(
                f"{name}: {len(layout)} sub-apertures, estimator {settings.estimator.name}; waiting for "
                "frames, Ctrl-C stops"
            )
            threading.Thread(target=_stop_when_set, args=(stop, engine), daemon=True).start()
            engine.run(frames)
    click.echo(summary(engine.status()))


def _learning(engine: Engine, config: str) -> AbstractContextManager[None]:
    """The process that learns for the engine, as a context, if it can learn and shall."""
    from faintspot.loop.control.base import KALMAN

    options = None if engine.loop is None else engine.loop.control.options
    if options is None or options.controller != KALMAN or not options.learn_every_s:
        return nullcontext()
    from faintspot.engine.background import background_learning

    return background_learning(engine, config, options.learn_every_s, partial(click.echo, err=True))


def _followed(stream: str, name: str) -> StreamBridge:
    """The stream as the engine's own source, which keeps a processor busy as waiting for rows would."""
    from faintspot.engine.streams.bridge import StreamBridge

    return StreamBridge(stream, name, say=partial(click.echo, err=True), spins=(os.cpu_count() or 1) > 1)


def _stop_when_set(stop: threading.Event, engine: Engine) -> None:
    """Pass a signal on to the engine."""
    stop.wait()
    engine.stop()
