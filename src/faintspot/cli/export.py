"""faintspot export: telemetry as a file that other software can use."""

from __future__ import annotations

from pathlib import Path

import click

from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs


@needs("realtime", "zarr", "aotpy")
@click.command()
@click.argument("telemetry", type=click.Path(path_type=Path))
@option("--output", "-o", metavar="FITS", help="File to write.", show_default="TELEMETRY.fits")
@option(
    "--ao-mode",
    type=click.Choice(["SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO"]),
    default="SCAO",
    help="What an AOT file says the sensor serves.",
)
def command(telemetry: Path, output: str | None, ao_mode: str) -> None:
    """Write telemetry as a file of the Adaptive Optics Telemetry standard (AOT).

    TELEMETRY is what `faintspot realtime record` wrote.

    \b
    Example:
      faintspot export night.zarr -o night.fits
    """
    from faintspot.io import read_telemetry, write_aot

    out = Path(output or derived(telemetry, ".fits"))
    if out.suffix != ".fits":
        raise InputError(f"{out}: expected a name that ends in .fits")
    recorded = read_telemetry(telemetry)
    write_aot(out, recorded, ao_mode=ao_mode)
    click.echo(f"{out}: {len(recorded.frame)} frames, {len(recorded.image_frame)} images")
