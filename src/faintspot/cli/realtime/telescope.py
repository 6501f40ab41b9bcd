"""faintspot realtime telescope and demo: a simulated telescope; the same with engine and page."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click
from rich.console import Console

from faintspot.base.files import output_errors
from faintspot.cli.commands import FRAMES, PORT, READOUT_FRACTION, name_option, needs, option
from faintspot.cli.output import results_table
from faintspot.cli.realtime.engine_requests import published, stop_on_signal
from faintspot.engine.processes.requests import TELESCOPE, socket_path

if TYPE_CHECKING:
    from rich.table import Table

    from faintspot.base.statistics import Estimate
    from faintspot.engine.page.demonstration import MethodShown, Shown


@click.command("telescope", short_help="Simulate a telescope whose mirror follows a command stream.")
@click.argument("configuration", metavar="[CONFIG]", default="canary")
@name_option("Name of the pixel ring and the streams.")
@option(
    "--frame-rate-hz",
    type=float,
    metavar="HZ",
    help="Frame rate; winds are scaled with it, so that the turbulence moves as far in a frame.",
    show_default="CONFIG",
)
@option(
    "--write-config", metavar="FOLDER", help="Write what an engine needs: faintspot.toml and two matrices."
)
@option(
    "--control",
    default="integrator",
    metavar="KIND",
    help="Control that --write-config prepares: integrator, or kalman, which learns for a minute.",
)
@option(
    "--wait",
    "waits",
    is_flag=True,
    help="Wait for the engine's command where it is late: time stands still meanwhile.",
)
@READOUT_FRACTION
@option(
    "--rows-per-block",
    type=int,
    metavar="K",
    help="Rows published together.",
    show_default="a sub-aperture's",
)
@FRAMES
@option(
    "--seed", type=click.IntRange(0), help="Seed of turbulence and noise.", show_default="the configuration's"
)
@option(
    "--realisation",
    type=click.IntRange(0),
    default=0,
    help="Number of the realisation; each has other turbulence and noise.",
)
@option(
    "--strehl",
    metavar="CSV",
    help="Write the true Strehl ratio of every frame, for faintspot telemetry --strehl.",
)
def telescope(
    configuration: str,
    name: str,
    frame_rate_hz: float | None,
    write_config: str | None,
    control: str,
    frames: int | None,
    strehl: str | None,
    **options: Any,
) -> None:
    """Simulate a telescope: turbulence, mirror, Shack-Hartmann sensor and camera, at a camera's pace.

    CONFIG is a TOML file or the name of a shipped configuration, as of `faintspot loop`; default: canary.
    Rows go into the pixel ring NAME. When an exposure begins, the mirror takes the newest commands of the
    pyshmem stream NAME_commands [nm]; whole frames are published as NAME_frames, and the true Strehl ratio
    and wavefront error as NAME_truth. Needs the extras `loop` and `realtime`.

    \b
    In three terminals:
      faintspot realtime telescope canary --frame-rate-hz 250 --write-config bench
      faintspot realtime run --config bench/faintspot.toml
      faintspot realtime send --telescope photons=50 seeing_arcsec=1.2
    """
    from faintspot.engine.processes.child_processes import real_time
    from faintspot.engine.processes.requests import ControlServer
    from faintspot.engine.telescope import LENGTHY, SimulatedTelescope, commands_of
    from faintspot.loop.simulation.configuration import load_loop
    from faintspot.loop.simulation.engine_files import write_engine_files

    observed = load_loop(configuration)
    if frame_rate_hz is not None:
        observed = observed.slowed_to(frame_rate_hz)
    if write_config is not None:
        click.echo(f"{name}: {write_engine_files(observed, write_config, control)} written")
    say = partial(click.echo, err=True)
    options = {key: value for key, value in options.items() if value is not None}
    options["say"] = lambda line: say(f"{name}: {line}")
    with ExitStack() as files:
        if strehl is not None:
            with output_errors(strehl):
                stream = files.enter_context(open(strehl, "w", encoding="utf-8"))
                stream.write("time_s,strehl,exposure_s\n")
            options["keep_truth"] = partial(write_strehl, stream, 1 / observed.control.frame_rate_hz)
        simulated = files.enter_context(SimulatedTelescope(observed, name, **options))
        optics = simulated.telescope_model.optics
        rows, columns = optics.sensor.layout.frame_shape
        server = ControlServer(socket_path(name, TELESCOPE), commands_of(simulated), lengthy=LENGTHY)
        with server, real_time(), stop_on_signal() as stop:
            click.echo(
                f"{name}: {observed.name}, {rows} x {columns} pixels, {len(optics.sensor.layout)} "
                f"sub-apertures, {optics.mirror.commands} commands, {observed.control.frame_rate_hz:g} "
                "frames/s; Ctrl-C stops"
            )
            report = simulated.run(frames, stop)
    click.echo(f"{name}: {published(report)}")


def write_strehl(stream: TextIO, exposure_s: float, truth: tuple[float, ...]) -> None:
    """Write Unix time of the middle, true Strehl ratio and duration of an exposure as a line of CSV."""
    _, strehl, *_, begun_s, _, _ = truth
    time_s = begun_s + exposure_s / 2 + time.time() - time.monotonic()
    with output_errors(stream.name):
        stream.write(f"{time_s:.4f},{strehl:.5f},{exposure_s:.6g}\n")


@needs("realtime,loop", "pyshmem", "tornado", "zarr", "hcipy")
@click.command("demo", short_help="Run a simulated telescope, the engine and its page together.")
@name_option("Name of the engine and its streams.")
@option("--output", "-o", metavar="FOLDER", default="faintspot-demo", help="Folder for what it makes.")
@option(
    "--flux-e", type=float, metavar="E", default=100.0, help="Photo-electrons per sub-aperture and frame."
)
@option("--frame-rate-hz", type=float, metavar="HZ", default=100.0, help="Frame rate.")
@option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    default=60.0,
    help="Time for which the loop is closed; then there is a table.",
)
@PORT
@option("--seed", type=click.IntRange(0), default=2015, help="Seed of the simulation.")
def demo(
    name: str, output: str, flux_e: float, frame_rate_hz: float, seconds: float, port: int, seed: int
) -> None:
    """Run a simulated telescope, the real-time engine and its web page together.

    The loop is closed on a faint star, methods alternate, and a table at the end gives the Strehl ratio of
    each. Needs the extras `realtime` and `loop`.
    """
    from faintspot.engine.page.demonstration import LiveDemonstration

    plan = LiveDemonstration(Path(output), flux_e, frame_rate_hz, name, port, seed)
    with stop_on_signal() as stop:
        shown = plan.run(stop, seconds, click.echo)
    methods = shown.by_method()
    if methods:
        Console().print(methods_table(methods))
    for line in in_words(shown):
        click.echo(line)


def methods_table(methods: list[MethodShown]) -> Table:
    """Return what every method has done as a table."""
    columns = ("Strehl ratio", f"over {methods[0].strehl.method}", "p50", "p99", "frames")
    table = results_table("method", *columns)
    for method in methods:
        difference = method.strehl.difference
        table.add_row(
            method.strehl.method,
            _plus_minus(method.strehl.mean, ""),
            "" if difference is None else _plus_minus(difference, "+"),
            f"{method.p50_us:.0f}",
            f"{method.p99_us:.0f}",
            str(method.frames),
        )
    table.caption = "Standard errors from blocks of turns; p50, p99 from the last row to the slopes, us."
    return table


def in_words(shown: Shown) -> list[str]:
    """Describe the run, besides the table."""
    status = shown.status
    if status is None:
        return ["ended before there was a loop"]
    counters, loop, camera = status["counters"], status["loop"], status["telescope"]
    reached = camera["frame_rate_hz"] * camera["frames"] / (camera["frames"] + camera["overruns"])
    lost = counters["dropped"] + counters["skipped"]
    latency = loop["latency"]
    lines = [
        f"{counters['processed']} frames measured, {lost} lost; from the last row to the commands p50 "
        f"{latency['p50_us']:.0f} us, p99 {latency['p99_us']:.0f} us",
        f"{reached:.0f} of {camera['frame_rate_hz']:g} frames/s: late commands are waited for",
    ]
    if math.isfinite(shown.on_time):
        lines.append(
            f"the commands acted after the delay that is set in {100 * shown.on_time:.1f} % of frames"
        )
    if math.isfinite(shown.open_strehl):
        lines.append(f"Strehl ratio of the open loop: {shown.open_strehl:.3f}")
    if loop["opened_because"]:
        lines.append(f"the loop was opened: {loop['opened_because']}")
    if not shown.by_method():
        lines.append("ended before every method had its turn")
    return lines


def _plus_minus(value: Estimate, sign: str) -> str:
    text = f"{value.value:{sign}.3f}"
    return f"{text} ± {value.standard_error:.3f}" if math.isfinite(value.standard_error) else text
