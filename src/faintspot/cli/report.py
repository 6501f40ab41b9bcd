"""faintspot report: a page of pictures and tables."""

from __future__ import annotations

from pathlib import Path

import click

from faintspot.errors import InputError
from faintspot.io.locations import split_location
from faintspot.study.recognise import study_attributes


@click.command(short_help="Make a web page of pictures and tables from slopes or a study.")
@click.argument("slopes", nargs=-1, required=True, metavar="SLOPES [OTHER_ARM]")
@click.option(
    "--output", "-o", metavar="HTML", help="Page to write. Default: the first file's name with .html."
)
@click.option(
    "--frames", multiple=True, metavar="FILE", help="The frames, if they are no longer where they were."
)
def command(slopes: tuple[str, ...], output: str | None, frames: tuple[str, ...]) -> None:
    """Make a web page of pictures and tables from slopes or a study.

    SLOPES is what `faintspot slopes` wrote; with a second one of the same frames (say, without denoising) the
    page compares the two. It holds the frame raw, calibrated, denoised and after the background subtraction,
    flux and validity maps, slope arrows, iterations and slope jitter, in one file without any links outside.

    The store of a study (`faintspot study`), finished or not, gives the page with its figures and verdicts.

    \b
    Examples:
      faintspot report slopes.zarr
      faintspot report slopes.zarr plain.zarr -o comparison.html
      faintspot report paper.zarr
    """
    from faintspot.report import report_of_stored, report_of_study, write_report

    paths = [Path(path) for path in slopes]
    if output is not None and Path(output).resolve() in [path.resolve() for path in paths]:
        raise InputError(f"{output}: expected a name for the page, got the slopes' own")
    if output is not None and not Path(output).absolute().parent.is_dir():
        raise InputError(
            f"{output}: the folder {Path(output).parent} does not exist: create it or choose another"
        )
    for name in frames:
        split_location(name)  # refuses what is not there
    if len(paths) == 1 and study_attributes(paths[0]) is not None:
        html = report_of_study(paths[0])
    else:
        html = report_of_stored(paths, frames=[Path(path) for path in frames] or None)
    target = output or str(paths[0].with_suffix(".html"))
    write_report(target, html)
    click.echo(f"{target}: open it in a browser")
