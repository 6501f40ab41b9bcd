"""faintspot realtime record: telemetry of a running engine to files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import InputError
from faintspot.cli.shared.commands import ENGINE_NAME, option
from faintspot.cli.shared.needs import needs

if TYPE_CHECKING:
    from faintspot.engine.telemetry.recorder import RecordingReport


@needs("realtime", "zarr")
@click.command("record", short_help="Record the telemetry of a running engine.")
@click.argument("out", type=click.Path(path_type=Path), metavar="OUT")
@ENGINE_NAME
@option("--frames", type=click.IntRange(1), help="Stop after so many.")
@option("--seconds", type=click.FloatRange(0, min_open=True), help="Stop after so long.")
def record(out: Path, name: str, frames: int | None, seconds: float | None) -> None:
    """Record slopes, fluxes, times, images and changes of settings of a running engine until Ctrl-C.

    OUT is a Zarr store (.zarr), which grows as frames come and is whole at any time; `faintspot export` makes
    an AOT file of it. The engine never waits: where reading or the disk is too slow, frames are lost to the
    record, and counted.

    \b
    Example:
      faintspot realtime record night.zarr --seconds 60
    """
    if out.suffix != ".zarr":
        raise InputError(f"{out}: expected a name that ends in .zarr")
    click.echo(f"{out}: {summary(record_engine(name, out, frames, seconds))}")


def record_engine(name: str, store: Path, frames: int | None, seconds: float | None) -> RecordingReport:
    """Record a running engine to a new store, with a progress bar, until a limit or Ctrl-C."""
    from faintspot.cli.shared.engine_requests import stop_on_signal
    from faintspot.cli.shared.progress import progress_bar
    from faintspot.engine.telemetry.recorder import Recorder

    recorder = Recorder(name, store)
    total: Any = frames  # None, where it is not known, makes the bar a moving one
    with stop_on_signal() as stop, progress_bar(store.name) as advance:
        return recorder.run(
            n_frames=frames, seconds=seconds, stop=stop, progress=lambda done: advance(done, total)
        )


def summary(report: RecordingReport) -> str:
    """Describe what was recorded and what was lost."""
    ended = {
        "frames": "all that were asked for",
        "seconds": "time is over",
        "stopped": "stopped",
        "engine ended": "the engine has ended",
    }[report.ended_because]
    text = (
        f"{report.frames} frames in {report.seconds:.1f} s, {report.images} with images, changes of "
        f"settings: {report.changes} ({ended})"
    )
    lost = report.dropped + report.dropped_images + report.dropped_changes
    if not lost:
        return f"{text}; nothing dropped"
    return (
        f"{text}\n  dropped: {report.dropped} frames, {report.dropped_images} images, "
        f"{report.dropped_changes} changes, overwritten in shared memory before they were read: this process "
        f"or the disk was too slow (the longest write took {report.longest_write_s:.2f} s)"
    )
