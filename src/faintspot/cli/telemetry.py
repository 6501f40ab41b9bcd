"""faintspot telemetry: report of a recorded loop of any system."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import derived, write_atomically
from faintspot.base.text_files import to_json
from faintspot.cli.commands import SectionedCommand, declared, needs, option
from faintspot.cli.output import progress_bar
from faintspot.io.zarr_store import holds_telemetry
from faintspot.slopes.sensor.layout import OPTICS, Layout

if TYPE_CHECKING:
    from faintspot.base.report.page import Report
    from faintspot.loop.control.identification.learnt_loop import ObservedLoop
    from faintspot.loop.control.identification.recording import Recording
    from faintspot.loop.telemetry.report import LoopReport

_LACKS = "What FILE lacks"


@needs("report", "matplotlib", "jinja2")
@click.command(cls=SectionedCommand)
@click.argument("recording", type=click.Path(path_type=Path), metavar="FILE")
@option("--system", metavar="TOML", help="Values that FILE lacks, such as rate, unit, matrix and geometry.")
@option(
    "-c",
    "--config",
    metavar="TOML",
    help="Configuration with [control], for recordings of the engine.",
    show_default="as recorded",
)
@option(
    "--strehl",
    metavar="CSV",
    help="Measured Strehl ratios for methods that alternated: Unix time of the middle, Strehl ratio and "
    "perhaps duration [s] of each exposure.",
)
@option(
    "--settle",
    metavar="FRAMES",
    type=click.IntRange(1),
    help="Frames at the beginning of each turn of a method that do not count.",
    show_default="delay and 3 / loop gain; 100 for filters",
)
@option("--one-loop", is_flag=True, help="Report the loop as a whole, although methods alternated.")
@option("--every", type=float, metavar="SECONDS", help="Turbulence against time as well, in such pieces.")
@option(
    "--fade-level",
    type=float,
    metavar="SHARE",
    default=0.5,
    help="Flux of the aperture below which its light fades, of the mean.",
)
@option("--slopes", metavar="NAME", section=_LACKS, help="Array in FILE, or file, with the slopes.")
@option("--commands", metavar="NAME", section=_LACKS, help="Array in FILE, or file, with the commands.")
@option(
    "--interaction-matrix",
    metavar="NAME",
    section=_LACKS,
    help="Array in FILE, or file, with the slopes for a unit of each command.",
)
@option("--control-matrix", metavar="NAME", section=_LACKS, help="The matrix from slopes to commands.")
@option(
    "--cells",
    metavar="NAME",
    section=_LACKS,
    help="Mask of the lenslet array, or row and column of each sub-aperture; none: there are none.",
    show_default="a full square",
)
@option("--slope-unit", metavar="UNIT", section=_LACKS, help="Unit of the slopes: px, arcsec or rad.")
@option(
    "--slope-order",
    metavar="ORDER",
    section=_LACKS,
    help="Order of slopes: pairs (x and y of each sub-aperture) or axes (all x, then all y).",
    show_default="axes",
)
@option("--frame-rate-hz", type=float, metavar="HZ", section=_LACKS, help="Frame rate.")
@declared(Layout, *OPTICS, sections="Telescope")
@option("--controller", metavar="NPZ", help="Learn a predictive controller as well, and write it to a file.")
@option("--output", "-o", metavar="HTML", help="Page to write.", show_default="FILE's, with .html")
def command(
    recording: Path,
    system: str | None,
    config: str | None,
    strehl: str | None,
    settle: int | None,
    one_loop: bool,
    every: float | None,
    fade_level: float,
    controller: str | None,
    output: str | None,
    **stated: float | str | None,
) -> None:
    """Report noise, turbulence, vibrations and control of a recorded loop, of any system.

    FILE is a store of `faintspot realtime record`, slopes of `faintspot slopes` (without a loop), an AOT
    file, a SPARTA table of ESO with its matrices beside it, a .sav file of Keck, cubes of milk's logger, a
    session of pyRTC, a folder of arrays, a file with slopes, or a TOML file that names arrays. Writes a page
    and, beside it, the same numbers as JSON. Every value has a 95 % interval. Of a loop it replays other
    gains and the predictive filter on the recorded turbulence. Recordings of the engine also show latencies,
    flags, slopes, wavefront and changes of settings. Takes a minute.

    Where methods alternated in a closed loop (realtime run --interleave), it compares them instead: Strehl
    ratio and residual phase, with hours of observing that would decide.

    \b
    Examples:
      faintspot telemetry night.zarr
      faintspot telemetry night.zarr --strehl times.csv
      faintspot telemetry slopes.zarr --frame-rate-hz 250 --every 60
      faintspot telemetry night_aot.fits --slope-unit px
      faintspot telemetry CIAO_LOOP_0001.fits --slope-unit px --cells mask.txt
      faintspot telemetry n0088_LGS_trs.sav --slopes B.DTTCENTROIDS --slope-unit arcsec
      faintspot telemetry loop.toml -o loop.html
      faintspot telemetry loop.npz --controller controller.npz
    """
    page = derived(recording, ".html") if output is None else Path(output)
    if not one_loop and controller is None and _alternates(recording):
        _report_night(recording, page, config, system, strehl, settle)
        return
    if strehl is not None or settle is not None:
        raise InputError(
            f"{recording}: --strehl and --settle: expected methods that alternated in a closed loop"
        )
    from faintspot.loop.telemetry.recorded_loop import read_recorded_loop

    given = {name: value for name, value in stated.items() if value is not None}
    loop = read_recorded_loop(recording, system, config, given)
    if controller is not None and not loop.is_closed:
        raise InputError("--controller: expected the recording of a closed loop, got an open one")
    report = _report_loop(loop, recording, page, every, fade_level)
    if controller is not None:
        _learn(loop, report.observed, controller)


def _report_loop(
    loop: Recording, recording: Path, target: Path, every_s: float | None, fade_level: float
) -> LoopReport:
    """Write the page and the numbers of a loop, and the turbulence of its pieces."""
    from faintspot.loop.telemetry.page import page_of_loop, table_of_pieces, turbulence_over_time
    from faintspot.loop.telemetry.report import report_of_loop

    pieces = []
    if every_s is not None:
        with progress_bar("pieces", "pieces") as advance:
            pieces = turbulence_over_time(loop, every_s, advance)
    report = report_of_loop(loop, lambda step: click.echo(f"{step} ...", err=True), fade_level=fade_level)
    if pieces:
        table = derived(target, "-over-time.csv")
        write_atomically(table, table_of_pieces(pieces))
        click.echo(table)
    remarks = filter(None, dict.fromkeys((*report.loop.remarks, *report.doubts, report.advice)))
    _write(recording, target, page_of_loop(report, pieces), report.as_values(), remarks)
    return report


def _write(
    recording: Path, target: Path, page: Report, values: dict[str, object], remarks: Iterable[str]
) -> None:
    """Write a page, with the sections that only recordings of the engine have, and its numbers."""
    numbers = derived(target, ".json")
    write_atomically(numbers, to_json(values, indent=1))
    if holds_telemetry(recording):
        from faintspot.loop.telemetry.engine_sections import with_engine

        page = with_engine(page, recording)
    page.write(target)
    for line in remarks:
        click.echo(line)
    click.echo(f"{target}: open it in a browser; {numbers} has the numbers")


def _learn(loop: Recording, observed: ObservedLoop | None, controller: str) -> None:
    """Learn a controller from a loop, and write it."""
    from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn

    click.echo("controller ...", err=True)
    with errors_within(f"{controller}: not written, keep the integrator"):
        control = learn(replace(loop, remarks=())) if observed is None else PredictiveControl.of(observed)
    control.save(controller)
    click.echo(f"{controller}: {control.summary()}")


def _alternates(recording: Path) -> bool:
    """Return whether a recording is of methods that alternated in a closed loop."""
    if not holds_telemetry(recording):
        return False
    from faintspot.experiments.night.recorded import alternates

    return alternates(recording)


def _report_night(
    recording: Path,
    target: Path,
    config: str | None,
    system: str | None,
    strehl: str | None,
    settle: int | None,
) -> None:
    """Write the page and the numbers of methods that alternated."""
    from faintspot.experiments.night import recorded
    from faintspot.experiments.night.recorded_methods import read_strehl

    measured = None if strehl is None else read_strehl(strehl)
    night = recorded.recorded_night(
        recording, configuration=config, system=system, strehl=measured, settle_frames=settle
    )
    page, values = recorded.page_of_recording(night), recorded.summary_of_recording(night)
    _write(recording, target, page, values, [recorded.text_of_recording(night)])
