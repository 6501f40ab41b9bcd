"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from faintspot.cli.shared.commands import option

Option = Callable[[Callable[..., Any]], Callable[..., Any]]


def configuration_option(what: str) -> Option:
    """Return --config: a configuration, and what it is to the command."""
    return option("-c", "--config", default="faintspot.toml", metavar="TOML", help=what)


def name_option(what: str) -> Option:
    """Return --name: what has it."""
    return option("--name", default="faintspot", help=what)


ENGINE_NAME = name_option("Name of the engine.")


def which_frames(**options: object) -> Option:
    """Return --key and --time-axis: which array of a file holds frames, and how."""
    key = option("--key", metavar="NAME", help="Which array to read of files that hold several.", **options)
    time_axis = option(
        "--time-axis",
        type=click.IntRange(0, 2),
        metavar="AXIS",
        help="Axis of a cube that counts the frames.",
        show_default="0, or the odd one of three of which two are equal",
        **options,
    )
    return lambda command: key(time_axis(command))


KEY = which_frames()
FRAMES = option(
    "--frames", type=click.IntRange(1), help="Stop after this number of frames.", show_default="at Ctrl-C"
)
SLOTS = option("--slots", type=int, default=4, help="Frames in the ring.")
READOUT_FRACTION = option(
    "--readout-fraction",
    type=float,
    metavar="PART",
    default=0.8,
    help="Read-out, as a part of the frame time.",
)
PORT = option(
    "--port", type=click.IntRange(0, 65535), default=8642, help="Port of the page; 0: any that is free."
)
REFERENCE = option(
    "--reference",
    metavar="FILE",
    help="Reference positions: slopes of a flat wavefront (their mean), or (n, 2) px as FILE[:ARRAY].",
)
AO_MODE = option(
    "--ao-mode",
    type=click.Choice(["SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO"]),
    default="SCAO",
    help="What an AOT file says the sensor serves.",
)
