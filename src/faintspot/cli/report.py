"""faintspot report: a page of pictures and tables."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(short_help="Make a web page of pictures and tables from slopes.")
@click.argument("slopes", nargs=-1, required=True, metavar="SLOPES [OTHER_ARM]")
@click.option(
    "--output", "-o", metavar="HTML", help="Page to write. Default: the first file's name with .html."
)
@click.option(
    "--frames", multiple=True, metavar="FILE", help="The frames, if they are no longer where they were."
)
def command(slopes: tuple[str, ...], output: str | None, frames: tuple[str, ...]) -> None:
    """Make a web page of pictures and tables from slopes.

    SLOPES is what `faintspot slopes` wrote; with a second one of the same frames (say, without denoising) the
    page compares the two. It holds the frame raw, calibrated, denoised and after the background subtraction,
    flux and validity maps, slope arrows, iterations and slope jitter, in one file without any links outside.

    \b
    Examples:
      faintspot report slopes.zarr
      faintspot report slopes.zarr plain.zarr -o comparison.html
    """
    from faintspot.report import report_of_stored, write_report

    target = output or str(Path(slopes[0]).with_suffix(".html"))
    html = report_of_stored([Path(path) for path in slopes], frames=[Path(path) for path in frames] or None)
    write_report(target, html)
    click.echo(f"{target}: open it in a browser")
