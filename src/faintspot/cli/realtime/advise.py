"""faintspot realtime advise: what telemetry tells of star, camera, turbulence and loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from faintspot.base.errors import InputError
from faintspot.base.extras import require_linux
from faintspot.cli.realtime.camera import stop_on_signal
from faintspot.cli.shared.commands import option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import ENGINE_NAME, configuration_option

if TYPE_CHECKING:
    from faintspot.engine.advising import Advice
    from faintspot.slopes.pipeline.settings import Settings


@needs("realtime", "pyshmem", "zarr")
@click.command("advise", short_help="Measure flux, noise, turbulence and centroid gain from telemetry.")
@configuration_option("Configuration of the engine.")
@ENGINE_NAME
@option("--seconds", type=click.FloatRange(1), default=10.0, help="Seconds of telemetry to look at.")
@option(
    "--from",
    "store",
    type=click.Path(path_type=Path),
    metavar="STORE",
    help="A recording, instead of a running engine.",
)
def advise(config: str, name: str, seconds: float, store: Path | None) -> None:
    """Measure flux, noise, turbulence and centroid gain from the telemetry of a closed loop.

    Prints flux, read noise, spot width, centroid gain, r0, wind, vibrations and residual wavefront with
    their errors, as far as telemetry has them. Flux and centroid gain need images (run --images-every).
    TOML's name with .advice.json keeps the results.

    \b
    Examples:
      faintspot realtime advise
      faintspot realtime advise --from night.zarr
    """
    from faintspot.engine.advising import Loop, recorded_settings, write_journal
    from faintspot.engine.advising import advise as advised
    from faintspot.io import read_telemetry

    if store is None:
        require_linux("realtime advise without --from")
    loop = Loop.load(config, name)
    if store is None:
        with stop_on_signal() as stop:
            telemetry, settings = loop.running(seconds, stop)
            if stop.is_set():
                return
    else:
        telemetry, settings = recorded_settings(read_telemetry(store), loop.control.options.gain)
    advice = advised(loop, telemetry, settings)
    lines = _lines(advice, settings)
    click.echo("\n".join(lines))
    if store is None:
        try:
            loop.ask("advice", lines=lines)
        except InputError as error:
            click.echo(f"the engine was not told: {error}", err=True)
    click.echo(f"{write_journal(config, advice.entry(name))} written")


def _lines(advice: Advice, settings: Settings) -> list[str]:
    """Return the measurements as lines."""
    lines = [f"{advice.frames} frames with {settings.estimator.name}"]
    return lines + [f"  {known.in_words()}" for known in advice.known]
