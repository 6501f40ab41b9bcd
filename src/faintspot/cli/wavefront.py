"""faintspot wavefront: Zernike modes from slopes."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import check_ending, derived
from faintspot.cli.commands import SectionedCommand, can_make, declared, errors_of_options, option
from faintspot.cli.output import picture_file, write_picture
from faintspot.io.frames import read_array
from faintspot.loop.control.flattening import Flattening, check_command_file, flattening, save_command
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.differences import difference
from faintspot.slopes.recorded.stored_run import StoredRun, open_run
from faintspot.slopes.sensor.layout import OPTICS, Layout
from faintspot.slopes.wavefront import Wavefront, certify, fit_drift, fit_wavefront, save_wavefront
from faintspot.slopes.wavefront.files import (
    WAVEFRONT_ENDING,
    certificate_table,
    drift_table,
    mode_table,
    remarks,
)
from faintspot.slopes.wavefront.fit import total

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDEST_HEADING = 12  # of numbers, characters
_SHOWN = 10  # modes, up to the spherical aberration, so that the certificate is on the same screen


@click.command(cls=SectionedCommand)
@click.argument("slopes", metavar="SLOPES")
@option("--output", "-o", metavar="FILE", help="File to write, .json.")
@option("--picture", metavar="PNG", help="Picture to write.", show_default="beside the slopes")
@option(
    "--modes",
    type=click.IntRange(2),
    metavar="N",
    help="Number of modes, from tip and tilt on.",
    show_default="by the sensor",
)
@option("--minus", metavar="SLOPES", help="Slopes of a recording whose mean wavefront is subtracted.")
@option("--drift", type=int, metavar="BINS", help="Drift of the modes, as means of so many bins of frames.")
@option("--frame-rate-hz", type=float, metavar="HZ", help="Frame rate, for the drift per hour.")
@option("--wavelength-nm", type=float, metavar="NM", help="Wavelength of the Strehl ratio.")
@option(
    "--actuators",
    metavar="FILE",
    section="Mirror",
    help="Interaction matrix, slopes for a unit of each actuator: finds the command that would flatten.",
)
@option("--stroke", type=float, section="Mirror", help="Stroke limit, in the matrix's unit.")
@option(
    "--command",
    "command_file",
    metavar="FILE",
    section="Mirror",
    help="File of the command, .npy or .csv.",
    show_default="beside the slopes",
)
@declared(Layout, *OPTICS, sections="Telescope")
def command(
    slopes: str,
    output: str | None,
    picture: str | None,
    modes: int | None,
    minus: str | None,
    drift: int | None,
    **options: Any,
) -> None:
    """Fit Zernike modes to slopes, draw the wavefront, and find the command that would flatten it.

    SLOPES is what `faintspot slopes` wrote (.zarr, .fits, .npz). Each frame is fitted by least squares over
    its valid sub-apertures; the tables show the mean, with standard errors, and its PV, rms, vergence and
    Strehl ratio with 95 % intervals. In nm when the pixels' scale and the size of a sub-aperture or of the
    telescope are known, from `faintspot layout` or the options here.

    \b
    Examples:
      faintspot wavefront slopes.zarr
      faintspot wavefront slopes.zarr --pixel-scale-arcsec 0.38 --diameter-m 4.2 -o wavefront.json
      faintspot wavefront warm.zarr --minus cold.zarr
      faintspot wavefront slopes.zarr --drift 24 --frame-rate-hz 0.5
      faintspot wavefront slopes.zarr --actuators interaction.npy --stroke 300
      faintspot wavefront slopes.zarr --actuators faintspot.control.npz:interaction_matrix
    """
    if output is not None:
        check_ending(Path(output), WAVEFRONT_ENDING)
    actuators, stroke = options["actuators"], options["stroke"]
    target = Path(options["command_file"] or derived(slopes, "_command.npy"))
    check_command_file(target)
    if actuators is None and (stroke is not None or options["command_file"] is not None):
        raise InputError("--stroke, --command: expected --actuators with an interaction matrix, got none")
    interaction = None if actuators is None else read_array(actuators)
    drawing = picture_file(Path(slopes), picture, "_wavefront.png")
    run = open_run(Path(slopes))
    if run.layout is None:
        raise InputError(f"{slopes}: expected slopes with their layout ({' '.join(run.notes)})")
    layout = replace(run.layout, **{name: options[name] for name in OPTICS if options[name] is not None})
    # A difference of positions in the frame lacks nothing.
    notes = [note for note in run.notes if minus is None or note != run.about_reference]
    measured, other = Slopes.from_variables(run.stored.variables, keep=run.keep), None
    if minus is not None:
        measured, other, about = difference(run, open_run(Path(minus)))
        notes += about
    elif (reference := _reference(run, notes)) is not None:
        # Slopes of sub-apertures that have no valid reference are not relative to it.
        measured, other = replace(measured, flags=reference[0].flags), reference[1]
    with errors_of_options(slopes):
        wavefront = fit_wavefront(measured, layout, modes=modes)
    if other is not None:
        with errors_of_options(minus or slopes):
            subtracted = fit_wavefront(other, layout, modes=len(wavefront.modes))
            wavefront = replace(wavefront, subtracted=subtracted)
    with errors_of_options(actuators):
        flat = None if interaction is None else flattening(measured, interaction, stroke)
    found = certify(wavefront, wavelength_nm=options["wavelength_nm"])
    with errors_of_options(slopes):
        over_time = None
        if drift is not None:
            over_time = fit_drift(wavefront, drift, frame_rate_hz=options["frame_rate_hz"])
    tables = [
        mode_table(wavefront, _SHOWN if modes is None else None),
        certificate_table(found, wavefront.unit),
    ]
    _print([*tables, drift_table(over_time, wavefront)] if over_time else tables, wavefront, notes)
    if output is not None:
        save_wavefront(output, wavefront, found, over_time)
        click.echo(output)
    if drawing is not None:
        from faintspot.slopes.wavefront.figure import drift_figure, wavefront_figure

        title = Path(slopes).name + ("" if minus is None else f" minus {Path(minus).name}")
        write_picture(wavefront_figure(wavefront, layout, title).figure, drawing)
        if over_time:
            write_picture(drift_figure(over_time, wavefront, title), derived(slopes, "_drift.png"))
    if flat is not None:
        _write_flattening(flat, target, measured, wavefront, layout)


def _reference(run: StoredRun, notes: list[str]) -> tuple[Slopes, Slopes] | None:
    """Return the slopes with the flags of their reference, and its own; add notes, also if it is exact."""
    file = str(run.stored.attributes.get("reference_file", ""))
    if not file:
        return None
    try:
        measured, other, about = difference(run, open_run(Path(file)))
    except InputError as error:
        notes.append(f"The reference {file} is taken as exact: {error}.")
        return None
    notes += about
    return measured, other


def _write_flattening(
    flat: Flattening, target: Path, measured: Slopes, wavefront: Wavefront, layout: Layout
) -> None:
    """Write and draw the command that would flatten the wavefront, and print what it removes."""
    moved_x, moved_y = flat.slopes_px.reshape(2, -1).astype(np.float32)
    left = replace(measured, x=measured.x + moved_x, y=measured.y + moved_y)
    after = fit_wavefront(left, layout, modes=len(wavefront.modes))
    before, left_over = (f"{total(part.mean):.3g}" for part in (wavefront, after))
    click.echo()
    for line in flat.remarks():
        click.echo(line)
    click.echo(
        f"In the fitted modes, {before} {wavefront.unit} rms of the mean wavefront become {left_over}."
    )
    save_command(target, flat.command)
    click.echo(f"command: {target}")
    if can_make("picture", "matplotlib"):
        write_picture(flattening_figure(flat, wavefront, after, layout), target.with_suffix(".png"))


def _print(tables: list[tuple[list[str], list[list[str]]]], wavefront: Wavefront, notes: list[str]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for header, rows in tables:
        table = Table(box=None, pad_edge=False)
        words = 2 if header[0] == "Noll" else 1
        for place, title in enumerate(header):
            if place < words:
                table.add_column(title)
            else:  # its heading is folded, so that no digit is cut off
                folded = textwrap.fill(title, _WIDEST_HEADING, break_long_words=False)
                table.add_column(folded, justify="right", no_wrap=True)
        for row in rows:
            table.add_row(*row)
        console.print(table)
        console.print()
    for line in (*remarks(wavefront), *notes):
        click.echo(line)


def flattening_figure(flat: Flattening, before: Wavefront, after: Wavefront, layout: Layout) -> Figure:
    """Draw the wavefront before and after the command, and the command of each actuator.

    Parameters
    ----------
    flat : Flattening
    before, after : Wavefront
        Fits to the slopes, and to the slopes with those of the command.
    layout : Layout
    """
    from faintspot.base.report.plots import METHOD_COLOURS, Line, Panel, plot
    from faintspot.slopes.wavefront.figure import wavefront_map

    largest = float(np.nanmax(np.abs(before.sheet())))
    cases = {"measured": before, "with the command": after}
    maps = [wavefront_map(wavefront, layout, when, largest=largest) for when, wavefront in cases.items()]
    style = {"color": METHOD_COLOURS[1], "drawstyle": "steps-mid", "marker": ".", "lw": 1}
    limits = [] if flat.stroke is None else [-flat.stroke, flat.stroke]
    levels = {0.0: {}, **{limit: {"ls": "--", "label": "stroke limit"} for limit in limits}}
    line = Line("command", np.arange(len(flat.command)), flat.command, style=style)
    panel = Panel([line], "actuator", "command (unit of the interaction matrix)", levels=levels, share=2)
    return plot([maps, [panel]], 9.6, heading="Command that would flatten the mean wavefront")
