"""faintspot report: a page of pictures and tables."""

from pathlib import Path

import click

from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.cli.commands import needs, option
from faintspot.experiments.store import kind_of_store
from faintspot.io.stored_array import split_location
from faintspot.io.zarr_store import holds_telemetry
from faintspot.loop.simulation.record import MAGNITUDE_FILE, holds_loop_results


@needs("report", "matplotlib", "jinja2")
@click.command()
@click.argument("slopes", nargs=-1, required=True, metavar="SLOPES [OTHER]")
@option(
    "--output", "-o", metavar="HTML", help="Page to write.", show_default="the first file's name with .html"
)
@option(
    "--recording", multiple=True, metavar="FILE", help="The frames, if they are no longer where they were."
)
def command(slopes: tuple[str, ...], output: str | None, recording: tuple[str, ...]) -> None:
    """Make a web page of pictures and tables from slopes, a study or a closed loop.

    SLOPES is what `faintspot slopes` wrote; with a second one of the same frames (say, without denoising) the
    page compares the two. It holds a frame raw, calibrated, denoised and after the background subtraction,
    maps of flux, validity and jitter, slope arrows and the wavefront, in one file without any links outside.

    The store of a study (`faintspot study`), finished or not, gives the page with its figures and verdicts.
    So does the folder of a closed-loop experiment (`faintspot loop`). Recordings of the engine have a page of
    `faintspot telemetry`.

    \b
    Examples:
      faintspot report slopes.zarr
      faintspot report slopes.zarr plain.zarr -o comparison.html
      faintspot report paper.zarr
      faintspot report canary -o canary.html
    """
    paths = [Path(path) for path in slopes]
    if output is not None and Path(output).resolve() in [path.resolve() for path in paths]:
        raise InputError(f"{output}: expected a name for the page, got the slopes' own")
    for name in recording:
        split_location(name)  # refuses what is not there
    target = Path(output) if output is not None else derived(paths[0], ".html")
    if len(paths) == 1 and holds_loop_results(paths[0]):
        from faintspot.experiments.closed_loop.results import MagnitudeResult
        from faintspot.experiments.closed_loop.verdict import loop_page

        report = loop_page(MagnitudeResult.load(paths[0] / MAGNITUDE_FILE))
        target = target if output is not None else paths[0] / "report.html"
    elif len(paths) == 1 and kind_of_store(paths[0]) == "study":
        from faintspot.experiments.report import report_of_study

        report = report_of_study(paths[0])
    elif len(paths) == 1 and holds_telemetry(paths[0]):
        raise InputError(f"{paths[0]}: expected slopes, got telemetry; use faintspot telemetry {paths[0]}")
    else:
        from faintspot.slopes.recorded.stored import report_of_stored

        report = report_of_stored(paths, frames=[Path(path) for path in recording] or None)
    report.write(target)
    click.echo(f"{target}: open it in a browser")
