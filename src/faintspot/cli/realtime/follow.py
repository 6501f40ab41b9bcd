"""faintspot realtime follow: the sodium profile of a running engine's laser guide star."""

from __future__ import annotations

import click

from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import ENGINE_NAME, configuration_option


@needs("realtime", "pyshmem")
@click.command("follow", short_help="Follow the sodium profile of a laser guide star.")
@configuration_option("Configuration of the engine, with [laser].")
@ENGINE_NAME
def follow(config: str, name: str) -> None:
    """Fit the sodium profile to the images of a running engine again and again until it ends.

    Each profile that differs is handed to the engine with the PSF of every sub-aperture, and with the linear
    matched filter if [laser] wants it; the engine measures with them from one frame to the next. The engine
    starts this command where [laser] has follow_every_s.

    \b
    Example:
      faintspot realtime follow --config faintspot.toml
    """
    from faintspot.engine.background.sodium import SodiumFollower

    SodiumFollower(name, config).run(click.echo)
