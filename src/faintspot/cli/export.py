"""faintspot export: weights and matrices, or telemetry, as a file that other software can use."""

from __future__ import annotations

from pathlib import Path

import click

from faintspot.base.extras import require
from faintspot.base.files import derived
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import AO_MODE, REFERENCE, configuration_option
from faintspot.cli.shared.output import write_aot_file


@needs("io", "astropy")
@click.command()
@click.argument("telemetry", type=click.Path(path_type=Path), required=False, metavar="[TELEMETRY]")
@configuration_option("Configuration to export.")
@option(
    "--output", "-o", metavar="FITS", help="File to write.", show_default="export.fits, or TELEMETRY.fits"
)
@REFERENCE
@AO_MODE
def command(
    telemetry: Path | None, config: str, output: str | None, reference: str | None, ao_mode: str
) -> None:
    """Write the weights of estimator window and the matrices of [control], or telemetry, as FITS.

    For SPARTA and other controllers that take a weighted centre of gravity and a control matrix: a map of
    weights for every sub-aperture with its gain and reference, the same as sums over the pixels, interaction
    matrix and control matrix.

    TELEMETRY is what `faintspot realtime record` wrote: it becomes a file of the Adaptive Optics Telemetry
    standard (AOT).

    \b
    Examples:
      faintspot export -c faintspot.toml -o export.fits
      faintspot export night.zarr -o night.fits
    """
    if telemetry is not None:
        require("realtime", "zarr", "aotpy", purpose="Writing an AOT file")
        write_aot_file(telemetry, Path(output or derived(telemetry, ".fits")), ao_mode)
        return
    from faintspot.adapters.export import export_fits

    target = output or "export.fits"
    click.echo(f"{target}: {', '.join(export_fits(config, target, reference=reference))}")
