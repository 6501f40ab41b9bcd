"""faintspot export: settings as the files that other controllers read."""

from __future__ import annotations

from typing import Any

import click

from faintspot.cli.shared.commands import Group, option
from faintspot.cli.shared.options import REFERENCE, configuration_option

_CONFIG = configuration_option("What to export.")


@click.group(cls=Group, short_help="Write settings as the files that other controllers read.")
def command() -> None:
    """Write settings as the files that other controllers read."""


@command.command("darc")
@_CONFIG
@option("--output", "-o", metavar="FOLDER", default="darc", help="A new folder.")
@REFERENCE
@option("--no-control", is_flag=True, help="Without the control matrix of [control].")
@option("--format", "form", type=click.Choice(["fits", "npy"]), default="fits", help="Format of arrays.")
def darc(config: str, output: str, reference: str | None, no_control: bool, form: str) -> None:
    """Write the parameters that users of DARC set by hand.

    Sub-apertures, calibration, brightest pixels, threshold or weights, references and, with [control], the
    control matrix: a file for each array, and parameters.txt, a line for each parameter. The estimator is
    brightest, thresholded, centroid or window.

    \b
    Examples:
      faintspot export darc -c faintspot.toml -o darc
      faintspot export darc --reference flat.zarr --format npy -o arrays
    """
    from faintspot.adapters.export.darc import LIST, export_darc

    parameters = export_darc(config, output, reference=reference, control=not no_control, form=form)
    for parameter in parameters:
        click.echo(f"{parameter.name:<16}{_shown(parameter.value):<24}{parameter.meaning}")
    click.echo(f"{output}: {len(parameters)} parameters; {LIST} lists them")


@command.command("weights")
@_CONFIG
@option("--output", "-o", metavar="FITS", default="weights.fits", help="What to write.")
@REFERENCE
def weights(config: str, output: str, reference: str | None) -> None:
    """Write the weights of estimator window as FITS.

    For SPARTA and other controllers that take a weighted centre of gravity: a map of weights for every
    sub-aperture with its gain and reference, and the same as sums over the pixels.

    \b
    Examples:
      faintspot export weights -c faintspot.toml -o weights.fits
    """
    from faintspot.adapters.export.weights import export_weights

    click.echo(f"{output}: {', '.join(export_weights(config, output, reference=reference))}")


def _shown(value: Any) -> str:
    """A value, or the shape and type of an array."""
    return str(value) if not hasattr(value, "shape") else f"{' x '.join(map(str, value.shape))} {value.dtype}"
