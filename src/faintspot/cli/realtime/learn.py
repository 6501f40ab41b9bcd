"""faintspot realtime calibrate and learn: the mirror measured by pokes, control learnt from a recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import derived
from faintspot.cli.commands import configuration_option, name_option, needs, option
from faintspot.cli.output import progress_bar


@needs("realtime", "zarr")
@click.command("learn", short_help="Learn a Kalman filter from a recording of the closed loop.")
@click.argument("store", type=click.Path(path_type=Path), metavar="STORE")
@configuration_option("Configuration with [control].")
@option(
    "--frame-rate-hz",
    type=click.FloatRange(0, min_open=True),
    metavar="HZ",
    help="Frame rate in the time of the turbulence, of a simulated telescope that waits.",
    show_default="as recorded",
)
def learn(store: Path, config: str, frame_rate_hz: float | None) -> None:
    """Learn a Kalman filter from a recording of the loop, closed with an integrator, and put it into TOML.

    STORE is what `faintspot realtime record` wrote while the engine ran with TOML, at least 200 frames
    without a gap; 2000 are better. The layout must know subaperture_m or diameter_m. Takes up to some
    minutes; writes TOML's name with .model.npz, and controller and model of [control]. A running engine
    learns again on its own, see learn_every_s of [control].

    \b
    Examples:
      faintspot realtime record night.zarr --seconds 10
      faintspot realtime learn night.zarr
    """
    from faintspot.base.flags import leave_out
    from faintspot.io import read_telemetry
    from faintspot.loop.control.base import KALMAN
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
    rate_hz = loop.frame_rate_hz if frame_rate_hz is None else frame_rate_hz
    _, delay, unknown = known_delay(replace(loop, frame_rate_hz=rate_hz))
    telemetry = open_loop_of(loop, delay).telemetry
    with progress_bar("Filter", "steps") as show:
        learnt = learn_controller(control.plant, telemetry, site_of(layout), rate_hz, progress=show)
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


@needs("realtime", "pyshmem")
@click.command("calibrate", short_help="Measure interaction matrix and reference slopes.")
@configuration_option("Configuration that gets [control].")
@name_option("Name of the engine and the streams.")
@option(
    "--actuators",
    type=click.IntRange(1),
    metavar="N",
    help="Actuators of the mirror.",
    show_default="as before, or as simulated",
)
@option("--amplitude", type=float, default=50.0, help="Amplitude of a poke, in the mirror's unit.")
@option(
    "--error",
    type=click.FloatRange(0, 1, min_open=True),
    default=0.05,
    help="Relative error of an actuator's slopes that half of the actuators must reach.",
)
@option("--rounds", type=click.IntRange(4), default=100, help="Most rounds.")
@option("--settle-frames", type=click.IntRange(1), default=3, help="Frames until a command acts.")
@option("--keep-reference", is_flag=True, help="Leave the reference slopes as they are.")
def calibrate(
    config: str,
    name: str,
    actuators: int | None,
    amplitude: float,
    error: float,
    rounds: int,
    keep_reference: bool,
    **averaging: int,
) -> None:
    """Poke the mirror up and down and measure what the slopes do, for [control] of the configuration.

    Pokes go out as the pyshmem stream NAME_commands, which the mirror must follow; a running engine without
    control (`run --no-control`) measures. Every actuator is poked in every round, until the errors, from the
    scatter between rounds, are small enough. A mirror that does not answer, and pokes that saturate, are
    refused. Writes TOML's name with .control.npz and .control.png, and [control] into it. Best with light
    that does not pass through moving air.

    \b
    Example:
      faintspot realtime run --no-control
      faintspot realtime calibrate --amplitude 50 --error 0.03
    """
    import numpy as np

    from faintspot.engine.control.poking import StreamedMirror
    from faintspot.loop.control.configuration import load_control
    from faintspot.loop.control.mirror_calibration import (
        calibrate_mirror,
        centroid_gain,
        save_calibration,
        save_picture,
    )
    from faintspot.slopes.pipeline.configuration import Configuration

    described = Configuration(config)
    layout, former = described.layout, load_control(described)
    if keep_reference and (former is None or former.reference is None):
        raise InputError(f"--keep-reference: expected reference_slopes in [control] of {config}")
    stroke = None if former is None else former.options.largest_command
    if stroke is not None and amplitude > stroke:
        raise InputError(f"--amplitude {amplitude:g}: expected at most largest_command, {stroke:g}")
    number = actuators or _known_commands(former, name)
    with StreamedMirror(name, number, **averaging) as mirror, progress_bar("pokes", "rounds") as advance:
        total: Any = None
        found = calibrate_mirror(mirror, amplitude, error, rounds, lambda done, _: advance(done, total))
    reference = former.reference if keep_reference and former else mirror.reference + found.reference
    if len(reference) != len(found.reference):
        raise InputError(f"{config}: {len(reference) // 2} sub-apertures, the engine's has another number")
    store = save_calibration(config, found, np.asarray(reference))
    written = [str(store)]
    try:
        save_picture(derived(store, ".png"), found, np.asarray(reference), layout)
        written.append(derived(store, ".png").name)
    except MissingExtraError as error:
        click.echo(f"no picture: {error}", err=True)
    for line in _in_words(found):
        click.echo(line)
    if former is not None and former.interaction.shape == found.interaction.shape:
        gain, gain_error = centroid_gain(found, former.interaction)
        click.echo(f"slopes are {gain:.3f} +- {gain_error:.3f} times those of the former matrix")
    click.echo(f"{', '.join(written)} and [control] of {config} written")


def _known_commands(former: Any, name: str) -> int:
    """Return the number of commands of the former calibration, or of a simulated telescope."""
    from faintspot.engine.processes.requests import TELESCOPE, request, socket_path

    if former is not None:
        return int(former.commands)
    try:
        return int(request(socket_path(name, TELESCOPE), "status")["commands"]["length"])
    except InputError:
        raise InputError("--actuators: expected the number of actuators of the mirror, got none") from None


def _in_words(found: Any) -> list[str]:
    """Describe the calibration."""
    import numpy as np

    slopes, commands = found.interaction.shape
    lines = [
        f"{commands} commands, {slopes} slopes, {found.rounds} rounds of +-{found.amplitude:g}; relative "
        f"error {np.median(found.relative_error):.3f}; pokes of half as much: {found.linearity:.3f} of what "
        "is in proportion"
    ]
    silent = np.flatnonzero(~found.answers)
    if len(silent):
        shown = ", ".join(map(str, silent[:20])) + (", ..." if len(silent) > 20 else "")
        lines.append(f"{len(silent)} commands without an answer, not used: {shown}")
    return lines
