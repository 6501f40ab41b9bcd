"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

Option = Callable[[Callable[..., Any]], Callable[..., Any]]


def configuration_option(what: str) -> Option:
    """Return --config: a configuration, and what it is to the command."""
    return click.option(
        "-c", "--config", default="faintspot.toml", show_default=True, metavar="TOML", help=what
    )


def name_option(what: str) -> Option:
    """Return --name: what has it."""
    return click.option("--name", default="faintspot", show_default=True, help=what)


ENGINE_NAME = name_option("Name of the engine.")
REFERENCE = click.option(
    "--reference",
    metavar="FILE",
    help="Reference positions: slopes of a flat wavefront (their mean), or (n, 2) px as FILE[:ARRAY].",
)
