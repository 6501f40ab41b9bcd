"""faintspot export: telemetry as a file that other software can use."""

from __future__ import annotations

from pathlib import Path

import click

from faintspot.base.files import derived
from faintspot.cli.shared.commands import AO_MODE, option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.output import write_aot_file


@needs("realtime", "zarr", "aotpy")
@click.command()
@click.argument("telemetry", type=click.Path(path_type=Path))
@option("--output", "-o", metavar="FITS", help="File to write.", show_default="TELEMETRY.fits")
@AO_MODE
def command(telemetry: Path, output: str | None, ao_mode: str) -> None:
    """Write telemetry as a file of the Adaptive Optics Telemetry standard (AOT).

    TELEMETRY is what `faintspot realtime record` wrote.

    \b
    Example:
      faintspot export night.zarr -o night.fits
    """
    write_aot_file(telemetry, Path(output or derived(telemetry, ".fits")), ao_mode)
