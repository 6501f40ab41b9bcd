"""faintspot realtime learn: control that learns from a recording of the closed loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from faintspot.base.errors import InputError, require_linux
from faintspot.base.files import derived
from faintspot.cli.shared.commands import ENGINE_NAME, configuration_option, option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.progress import progress_bar


@needs("realtime", "zarr")
@click.command("learn", short_help="Learn a Kalman filter from a recording of the closed loop.")
@click.argument("store", type=click.Path(path_type=Path), metavar="STORE", required=False)
@configuration_option("Configuration with [control].")
@option(
    "--every",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    help="Instead of from STORE, learn from the running engine, whenever this many seconds have passed.",
)
@ENGINE_NAME
@option(
    "--winds",
    type=click.Choice(["learnt", "none"]),
    default="learnt",
    help="Measure the winds, or take them from all directions alike.",
)
@option(
    "--layer",
    "layers",
    type=(float, float, float),
    multiple=True,
    metavar="SPEED DIRECTION STRENGTH",
    help="Assume a layer with this wind, m/s and degrees from +x to +y; repeatable.",
)
def learn(
    store: Path | None,
    config: str,
    every: float | None,
    name: str,
    winds: str,
    layers: tuple[tuple[float, float, float], ...],
) -> None:
    """Learn a Kalman filter from a recording of the loop, closed with an integrator, and put it into TOML.

    STORE is what `faintspot realtime record` wrote while the engine ran with TOML, at least 200 frames
    without a gap; 2000 are better. The layout must know subaperture_m or diameter_m. Takes up to some
    minutes; writes TOML's name with .model.npz, and controller and model of [control].

    With --every, learn a Kalman filter again from a running engine until it ends. A new filter is compared
    with the running one on frames that neither learnt from; the engine takes it if it is better beyond the
    error. The engine does this by itself, see learn_every_s of [control]. Nothing is written.

    \b
    Examples:
      faintspot realtime record night.zarr --seconds 10
      faintspot realtime learn night.zarr
      faintspot realtime learn night.zarr --layer 6 20 0.6 --layer 14 150 0.4
      faintspot realtime learn --every 10
    """
    if (store is None) == (every is None):
        raise InputError("learn: expected either STORE or --every")
    if store is None and every is not None:
        _learn_repeatedly(name, config, every)
    elif store is not None:
        _learn_from(store, config, winds, layers)


def _learn_repeatedly(name: str, config: str, every_s: float) -> None:
    """Learn from a running engine again and again."""
    require_linux("realtime learn --every")
    from faintspot.engine.background import BackgroundLearning

    BackgroundLearning(name, config, every_s).run(click.echo)


def _learn_from(store: Path, config: str, winds: str, layers: tuple[tuple[float, float, float], ...]) -> None:
    """Learn from a recording."""
    from faintspot.base.flags import leave_out
    from faintspot.io import read_telemetry
    from faintspot.loop.control.base import ASSUMED, KALMAN
    from faintspot.loop.control.configuration import load_control, prior_std_px, save_control
    from faintspot.loop.control.identification.learning import learn_controller
    from faintspot.loop.control.identification.open_loop import known_delay, open_loop_of
    from faintspot.loop.telemetry.recording import recorded_loop, site_of
    from faintspot.slopes.pipeline.configuration import Configuration

    described = Configuration(config)
    control = load_control(described)
    if control is None:
        raise InputError(f"{config}: expected a table [control], which calibrate writes")
    layout, recording = described.layout, read_telemetry(store, images=False)
    prior = prior_std_px(described.settings, layout)
    loop = recorded_loop(recording, control, layout, prior)
    _, delay, unknown = known_delay(loop)
    telemetry, rate_hz = open_loop_of(loop, delay).telemetry, loop.frame_rate_hz
    known = site_of(layout, layers), rate_hz, ASSUMED if layers else winds
    with progress_bar("Filter", "steps") as show:
        learnt = learn_controller(control.plant, telemetry, *known, progress=show)
    path = derived(config, ".model.npz")
    replace(learnt, centroid_gain=delay.gain).save(path)
    save_control(config, controller=KALMAN, model=path.name)
    left, left_out = learnt.left, leave_out(recording.flags)[1]
    if left_out:
        click.echo(left_out)
    click.echo(
        f"{len(telemetry)} frames at {rate_hz:.0f} a second: the filter leaves {left[0] / left[1]:.2f} of "
        f"the phase variance that the integrator with gain {learnt.plain_gain:g} leaves"
    )
    click.echo(f"{unknown}; the centroid gain of [control] is used" if unknown else delay.gain_summary)
    click.echo(f"{learnt.description}; {path} and [control] of {config} written")
