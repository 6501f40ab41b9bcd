"""faintspot realtime status, send, stop, load, unload, record: requests to a running engine or telescope."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from faintspot.base.errors import InputError
from faintspot.base.tables import parse_changes
from faintspot.base.text_files import check_keys, to_json
from faintspot.cli.commands import ENGINE_NAME, RANGES, needs, option
from faintspot.cli.realtime.engine_requests import (
    asked,
    asked_at_length,
    loop_in_words,
    notes,
    stop_on_signal,
    summary,
)
from faintspot.engine.processes.requests import ENGINE, TELESCOPE, since

if TYPE_CHECKING:
    from faintspot.engine.telemetry.recorder import RecordingReport


_REFRESH_S = 0.5
_ALONE = {"methods": ("methods", "every"), "loop": ("loop",), "gain": ("gain",), "spots": ("spots",)}
"""Names that `send` does not take together with settings, and what may stand beside them."""
_OF_TELESCOPE = option("--telescope", is_flag=True, help="Ask the simulated telescope of that name instead.")


@click.command("status", short_help="Show counters, latencies, loop or settings of a running engine.")
@ENGINE_NAME
@option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
@option("--watch", is_flag=True, help="Show them until Ctrl-C.")
@_OF_TELESCOPE
@click.argument("settings", nargs=-1, metavar="[SETTING]...")
def status(name: str, as_json: bool, watch: bool, telescope: bool, settings: tuple[str, ...]) -> None:
    """Show counters, latencies and the loop of a running engine, or the values of settings.

    SETTING is the name of a setting, or "all". Defaults are filled in; null is what is not used, or found
    from the PSF or each frame.

    \b
    Examples:
      faintspot realtime status
      faintspot realtime status keep_brightest noise_std
    """
    if telescope and (settings or watch):
        raise InputError("--telescope: expected it without settings and --watch, which are of an engine")
    if settings:
        names = None if "all" in settings else list(settings)
        for key, value in asked(name, "get", names=names)["settings"].items():
            click.echo(f"{key} = {to_json(value)}")
        return
    if watch:
        _watch(name)
        return
    reply = asked(name, "status", TELESCOPE if telescope else ENGINE)
    if as_json:
        click.echo(to_json(reply, indent=1))
    else:
        click.echo(_telescope_in_words(name, reply) if telescope else summary(reply))


def _watch(name: str) -> None:
    """Show the table of an engine in the terminal until Ctrl-C."""
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


@click.command("send", short_help="Change settings, methods or the loop of a running engine.")
@ENGINE_NAME
@option(
    "--subapertures",
    type=RANGES,
    metavar="LIST",
    help="Sub-apertures to change, such as 4,5,10-20.",
    show_default="all",
)
@_OF_TELESCOPE
@click.argument("changes", nargs=-1, required=True, metavar="NAME=VALUE...")
def send(name: str, subapertures: list[int] | None, telescope: bool, changes: tuple[str, ...]) -> None:
    """Change a running engine between two frames, or a simulated telescope from the next exposure on.

    All changes are made at once or not at all; the answer comes when they are in effect. NAME is that of a
    setting. Kernels that this machine has not used yet are compiled first, which takes up to half a minute,
    once; frames are measured as before meanwhile, and status says so. Or NAME is, alone:

    \b
    methods  settings that alternate, as of run --interleave, each for `every` frames [default: 50]; "set"
             ends it
    loop     open: the mirror keeps its commands; close: start from its present commands; flat: flatten the
             mirror of an open loop. A guard opens the loop when the slopes diverge or too many are not
             valid; status says why
    gain     loop gain
    spots    configuration file whose PSF and weights are used from then on, as `faintspot sodium`
             leaves it

    \b
    With --telescope:
    photons        photo-electrons of a fully lit sub-aperture in a frame, or
    magnitude      of the star, in the configuration's band
    r0_m           Fried parameter at 500 nm; two values: the ends of its drift, or
    seeing_arcsec  0.976 x 500 nm / r0
    wind_factor    all winds, as a multiple of the configuration's

    \b
    Examples:
      faintspot realtime send noise_std=2.5 keep_brightest=20 --subapertures 4,5,10-20
      faintspot realtime send methods=none,tv every=100
      faintspot realtime send loop=close
      faintspot realtime send --telescope magnitude=11 seeing_arcsec=1.2 wind_factor=1.5
    """
    wanted = parse_changes(changes, texts=("methods", "loop", "spots"))
    for alone, beside in _ALONE.items():
        if alone in wanted and not telescope:
            check_keys("", wanted, beside, what=f"name beside {alone}")
    if subapertures is not None and (telescope or wanted.keys() & _ALONE.keys()):
        raise InputError("--subapertures: expected settings to change in them, got something else")
    if telescope:
        reply = asked(name, "set", TELESCOPE, changes=wanted)
        click.echo(f"{since(reply['frame'])}: {_conditions_in_words(reply['conditions'])}")
    elif "loop" in wanted:
        click.echo(loop_in_words(asked(name, "loop", action=wanted["loop"])["loop"]))
    elif "gain" in wanted:
        click.echo(loop_in_words(asked(name, "loop", action="gain", **wanted)["loop"]))
    elif "spots" in wanted:
        click.echo(since(asked_at_length(name, "spots", spots=str(Path(wanted["spots"]).resolve()))["frame"]))
    elif "methods" in wanted:
        click.echo(since(asked_at_length(name, "interleave", **wanted)["frame"]))
    else:
        click.echo(since(asked_at_length(name, "set", changes=wanted, where=subapertures)["frame"]))


@click.command("stop")
@ENGINE_NAME
def stop_engine(name: str) -> None:
    """End a running engine."""
    asked(name, "stop")


@click.command("load", short_help="Load an estimator from a Python file into a running engine.")
@ENGINE_NAME
@click.argument("file", metavar="FILE", type=click.Path(dir_okay=False, resolve_path=True))
@option("--use", is_flag=True, help="Measure with it from now on, as send estimator=NAME does.")
@option("--replace", is_flag=True, help="Replace loaded estimators of the same names, between two frames.")
def load(name: str, file: str, use: bool, replace: bool) -> None:
    """Load the estimators that a Python file registers into a running engine.

    They are tried in a process of their own first, and refused where they fail, crash, return what they must
    not, or do not return. The file runs with all rights of the engine.

    \b
    Example:
      faintspot realtime load examples/own_estimator.py
      faintspot realtime send estimator=power power=2
    """
    reply = asked_at_length(name, "load", source=file, replace=replace)
    names, frame = reply["estimators"], reply["frame"]
    if use:
        if len(names) != 1:
            raise InputError(f"--use: expected one estimator in {file}, got {', '.join(names)}")
        frame = asked_at_length(name, "set", changes={"estimator": names[0]}, where=None)["frame"]
    click.echo(f"{', '.join(names)}: loaded from {file}{'' if frame is None else f', {since(frame)}'}")


@click.command("unload", short_help="Unload an estimator from a running engine.")
@ENGINE_NAME
@click.argument("estimator")
def unload(name: str, estimator: str) -> None:
    """Unload an estimator; where it is in use, the built-in estimator before takes over."""
    frame = asked_at_length(name, "unload", estimator=estimator)["frame"]
    click.echo(f"{estimator}: unloaded{'' if frame is None else f', {since(frame)}'}")


def _telescope_in_words(name: str, reply: dict[str, Any]) -> str:
    """Summarise the state of a simulated telescope."""
    commands, truth = reply["commands"], reply["truth"]
    state = commands["obstacle"] or f"{commands['taken']} taken, {commands['refused']} refused"
    lines = [
        f"{name}: {reply['configuration']}, {reply['frames']} frames at {reply['frame_rate_hz']:g} a second, "
        f"{reply['late']} late, {reply['overruns']} frame times without a frame",
        _conditions_in_words(reply["conditions"]),
        f"{commands['stream']}: {state}",
    ]
    if truth is not None:
        lines.append(
            f"frame {truth['frame']:.0f}: Strehl ratio {truth['strehl']:.3f}, {truth['rms_nm']:.0f} nm"
        )
    return "\n  ".join(lines)


def _conditions_in_words(conditions: dict[str, Any]) -> str:
    low, high = sorted(conditions["r0_m"])
    r0 = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
    photons, winds = conditions["photons"], conditions["wind_factor"]
    return f"{photons:g} photons, r0 {r0} m, winds x {winds:g}"


@needs("realtime", "zarr")
@click.command("record", short_help="Record the telemetry of a running engine.")
@click.argument("out", type=click.Path(path_type=Path), metavar="OUT")
@ENGINE_NAME
@option("--frames", type=click.IntRange(1), help="Stop after so many.")
@option("--seconds", type=click.FloatRange(0, min_open=True), help="Stop after so long.")
def record(out: Path, name: str, frames: int | None, seconds: float | None) -> None:
    """Record slopes, fluxes, times, images and changes of settings of a running engine until Ctrl-C.

    OUT is a Zarr store (.zarr), which grows as frames come and is whole at any time;
    `faintspot export telemetry` makes an AOT file of it. The engine never waits: where reading or the disk is
    too slow, frames are lost to the record, and counted.

    \b
    Example:
      faintspot realtime record night.zarr --seconds 60
    """
    if out.suffix != ".zarr":
        raise InputError(f"{out}: expected a name that ends in .zarr")
    from faintspot.cli.output import progress_bar
    from faintspot.engine.telemetry.recorder import Recorder

    recorder = Recorder(name, out)
    total: Any = frames  # None, where it is not known, makes the bar a moving one
    with stop_on_signal() as stop, progress_bar(out.name) as advance:
        report = recorder.run(
            n_frames=frames, seconds=seconds, stop=stop, progress=lambda done: advance(done, total)
        )
    click.echo(f"{out}: {_summary(report)}")


def _summary(report: RecordingReport) -> str:
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
