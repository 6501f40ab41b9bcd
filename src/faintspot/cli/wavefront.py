"""faintspot wavefront: Zernike modes from slopes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from faintspot.base.errors import InputError, errors_within
from faintspot.base.extras import require
from faintspot.cli.shared.commands import SectionedCommand, declared, option
from faintspot.cli.shared.output import picture_file, write_picture
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.stored_run import open_run
from faintspot.slopes.sensor.layout import OPTICS, Layout
from faintspot.slopes.wavefront import Wavefront, fit_wavefront, save_wavefront
from faintspot.slopes.wavefront.files import check_ending
from faintspot.slopes.wavefront.words import mode_table, remarks, rms_table


@click.command(cls=SectionedCommand)
@click.argument("slopes", metavar="SLOPES")
@option(
    "--output",
    "-o",
    metavar="FILE",
    multiple=True,
    help="File to write, .csv, .json or .fits; may be repeated.",
)
@option("--picture", metavar="PNG", help="Picture to write.", show_default="beside the slopes")
@option(
    "--modes",
    type=click.IntRange(2),
    metavar="N",
    help="Number of modes, from tip and tilt on.",
    show_default="by the sensor",
)
@declared(Layout, *OPTICS, sections="Telescope")
def command(
    slopes: str, output: tuple[str, ...], picture: str | None, modes: int | None, **scales: float | None
) -> None:
    """Fit Zernike modes (Noll's order) to slopes, and draw the wavefront.

    SLOPES is what `faintspot slopes` wrote (.zarr, .fits, .npz). Each frame is fitted by least squares over
    its valid sub-apertures; the table shows the mean, with standard errors. In nm when the pixels' scale and
    the size of a sub-aperture or of the telescope are known, from `faintspot layout` or the options here.

    \b
    Examples:
      faintspot wavefront slopes.zarr
      faintspot wavefront slopes.zarr --pixel-scale-arcsec 0.38 --diameter-m 4.2 -o wavefront.json
    """
    for name in output:
        check_ending(Path(name))
        if Path(name).suffix.lower() == ".fits":
            require("io", "astropy", purpose="Writing a FITS file")
    drawing = picture_file(Path(slopes), picture, "_wavefront.png")
    run = open_run(Path(slopes))
    if run.layout is None:
        raise InputError(f"{slopes}: expected slopes with their layout ({' '.join(run.notes)})")
    given: dict[str, Any] = {name: value for name, value in scales.items() if value is not None}
    layout = replace(run.layout, **given)
    with errors_within(slopes):
        measured = Slopes.from_variables(run.stored.variables, keep=run.keep)
        wavefront = fit_wavefront(measured, layout, modes=modes)
    _print(wavefront)
    for note in run.notes:
        click.echo(note)
    for name in output:
        save_wavefront(name, wavefront)
        click.echo(name)
    if drawing is not None:
        from faintspot.slopes.wavefront.figure import wavefront_figure

        write_picture(wavefront_figure(wavefront, layout, Path(slopes).name).figure, drawing)


def _print(wavefront: Wavefront) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for header, rows in (mode_table(wavefront), rms_table(wavefront)):
        table = Table(box=None, pad_edge=False)
        words = 2 if header[0] == "mode" else 1
        for place, title in enumerate(header):
            table.add_column(title, justify="left" if place < words else "right")
        for row in rows:
            table.add_row(*row)
        console.print(table)
        console.print()
    for line in remarks(wavefront):
        click.echo(line)
