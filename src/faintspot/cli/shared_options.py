"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from faintspot.cli.commands import option

Option = Callable[[Callable[..., Any]], Callable[..., Any]]


def configuration_option(what: str) -> Option:
    """Return --config: a configuration, and what it is to the command."""
    return option("-c", "--config", default="faintspot.toml", metavar="TOML", help=what)


def name_option(what: str) -> Option:
    """Return --name: what has it."""
    return option("--name", default="faintspot", help=what)


ENGINE_NAME = name_option("Name of the engine.")
PIXEL_SCALE = option(
    "--pixel-scale-arcsec",
    type=float,
    metavar="ARCSEC",
    help="Side of a pixel on the sky: for slopes in arcsec and wavefronts.",
    section="Telescope",
)
SUBAPERTURE = option(
    "--subaperture-m",
    type=float,
    metavar="M",
    help="Side of a sub-aperture in the telescope's pupil.",
    section="Telescope",
)
DIAMETER = option(
    "--diameter-m", type=float, metavar="M", help="Diameter of the telescope's pupil.", section="Telescope"
)
REFERENCE = option(
    "--reference",
    metavar="FILE",
    help="Reference positions: slopes of a flat wavefront (their mean), or (n, 2) px as FILE[:ARRAY].",
)
