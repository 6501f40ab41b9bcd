"""faintspot telemetry: report of a recorded loop of any system."""

from __future__ import annotations

import json
from pathlib import Path

import click

from faintspot.base.files import derived, write_atomically
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs


@needs("web", "matplotlib", "jinja2")
@click.command(short_help="Report noise, turbulence, vibrations and control of a recorded loop.")
@click.argument("recording", type=click.Path(path_type=Path), metavar="FILE")
@option("--system", metavar="TOML", help="Values that FILE lacks, such as rate, unit, matrix and geometry.")
@option("-c", "--config", metavar="TOML", help="Configuration with [control], for recordings of the engine.")
@option("--output", "-o", metavar="HTML", help="Page to write.", show_default="FILE's name with .html")
def command(recording: Path, system: str | None, config: str | None, output: str | None) -> None:
    """Report noise, turbulence, vibrations and control of a recorded loop, of any system.

    FILE is a store of `faintspot realtime record`, an AOT file (FITS), a TOML file that names arrays, or a
    NumPy or CSV file with slopes. Writes a page and, beside it, the same numbers as JSON. Every value has a
    95 % interval. It replays other gains and a predictive filter on the recorded turbulence. Takes a minute.

    \b
    Examples:
      faintspot telemetry night.zarr --config faintspot.toml
      faintspot telemetry night_aot.fits --system rate_and_unit.toml
      faintspot telemetry loop.toml -o loop.html
    """
    from faintspot.loop.telemetry.page import page_of_loop
    from faintspot.loop.telemetry.recorded_loop import read_recorded_loop
    from faintspot.loop.telemetry.report import report_of_loop

    loop = read_recorded_loop(recording, system, config)
    report = report_of_loop(loop, lambda step: click.echo(f"{step} ...", err=True))
    page = Path(output) if output is not None else derived(recording, ".html")
    numbers = derived(page, ".json")
    write_atomically(numbers, json.dumps(report.as_values(), indent=1))
    write_atomically(page, page_of_loop(report))
    click.echo(f"{page}: open it in a browser; {numbers} has the numbers")
