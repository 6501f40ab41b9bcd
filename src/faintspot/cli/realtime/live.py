"""faintspot live: a web page of a running engine, or of a recording."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from faintspot.base.errors import require, require_linux
from faintspot.cli.shared.commands import ENGINE_NAME, PORT, option
from faintspot.cli.shared.needs import needs

if TYPE_CHECKING:
    from faintspot.engine.page.server import LiveServer

_NICENESS = 5  # the engine comes first


@needs("realtime", "tornado", "pyshmem", "zarr")
@click.command()
@click.argument("recording", type=click.Path(path_type=Path), required=False, metavar="[RECORDING]")
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
def command(recording: Path | None, name: str, bind: str, port: int, private: bool, folder: Path) -> None:
    """Serve a web page of the running engine NAME until Ctrl-C.

    The page shows frames, slopes, flux, validity, latencies and alternating methods. The printed address
    allows settings to be changed; without its part from # on, a browser on this machine may only watch. The
    page reads telemetry as a recorder does, so the engine never waits for it.

    \b
    Examples:
      faintspot live
      faintspot live night.zarr
    """
    from faintspot.cli.shared.engine_requests import stop_on_signal
    from faintspot.engine.page.server import serve

    if recording is None:
        require_linux("live without a recording")
    os.nice(_NICENESS)
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # pushes nobody aside when it wakes
    with stop_on_signal() as stop:
        shown = name if recording is None else recording
        serve(shown, stop, _say, address=bind, port=port, private=private, folder=folder)


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
