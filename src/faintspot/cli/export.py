"""faintspot export: weights and matrices as a file that other controllers can use."""

from __future__ import annotations

import click

from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import REFERENCE, configuration_option


@needs("io", "astropy")
@click.command(short_help="Write weights and matrices as FITS for other controllers.")
@configuration_option("Configuration to export.")
@option("--output", "-o", metavar="FITS", default="export.fits", help="File to write.")
@REFERENCE
def command(config: str, output: str, reference: str | None) -> None:
    """Write the weights of estimator window and the matrices of [control] as FITS.

    For SPARTA and other controllers that take a weighted centre of gravity and a control matrix: a map of
    weights for every sub-aperture with its gain and reference, the same as sums over the pixels, interaction
    matrix and control matrix.

    \b
    Example:
      faintspot export -c faintspot.toml -o export.fits
    """
    from faintspot.adapters.export import export_fits

    click.echo(f"{output}: {', '.join(export_fits(config, output, reference=reference))}")
