"""faintspot loop: closed-loop experiments."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from faintspot.cli.loop.night import night
from faintspot.cli.loop.tune import tune
from faintspot.cli.shared.commands import Group, option
from faintspot.cli.shared.needs import needs
from faintspot.cli.shared.options import SCHEDULER, WORKERS
from faintspot.cli.shared.progress import progress_bar

_needs_loop = needs("loop", "hcipy", "joblib", "zarr", "matplotlib", "jinja2")


def _experiment_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of every experiment."""
    for each in (
        option("--overwrite", is_flag=True, help="Replace another experiment in the folder."),
        SCHEDULER,
        WORKERS,
        option("--quick", is_flag=True, help="Fewer and shorter runs: a few minutes."),
        option(
            "--output", "-o", metavar="FOLDER", help="Where results go.", show_default="NAME, or NAME-quick"
        ),
        click.argument("configuration", metavar="[CONFIG]", default="canary"),
    ):
        command = each(command)
    return command


@click.group(name="loop", cls=Group, short_help="Compare methods in a simulated closed loop.")
def command() -> None:
    """Compare methods in a simulated closed loop, and recommend one.

    Telescope, turbulence, Shack-Hartmann sensor, camera, mirror and control are simulated; slopes come from
    the same pipeline as everywhere. CONFIG is a TOML file or the name of a shipped configuration. Needs the
    extra `loop`. An interrupted command continues where it stopped.

    \b
    Examples:
      faintspot loop tune diffraction_limit
      faintspot loop magnitude camera_3e --methods brightest,smoothed,tv
      faintspot loop show canary > mine.toml
    """


command.add_command(tune)
command.add_command(night)


@command.command(name="list", short_help="List the shipped configurations.")
def list_shipped() -> None:
    """List the shipped configurations."""
    from faintspot.loop.simulation.configuration.configuration import load_loop, shipped_loops

    for name in shipped_loops():
        loop = load_loop(name)
        camera, sensor = loop.camera, loop.sensor
        noise = camera.read_noise_e / camera.em_gain
        click.echo(
            f"{name:18s} {loop.telescope.diameter_m:g} m, {sensor.subapertures}x{sensor.subapertures} "
            f"sub-apertures of {sensor.pixels}x{sensor.pixels} pixels, {noise:g} e- read noise, "
            f"{loop.photons:g} photons"
        )


@command.command(short_help="Print a configuration as TOML.")
@click.argument("name", metavar="CONFIG")
def show(name: str) -> None:
    """Print a configuration, shipped or of a file, as TOML with every value written out."""
    from faintspot.loop.simulation.configuration.configuration import load_loop

    click.echo(load_loop(name).to_text(), nl=False)


@_needs_loop
@command.command(short_help="Measure the Strehl ratio against the star's magnitude.")
@_experiment_options
@option("--methods", metavar="NAMES", help="Methods to compare, with commas.", show_default="all that suit")
@option(
    "--flux-e",
    metavar="NUMBERS",
    help="Fluxes with commas, photo-electrons per sub-aperture and frame.",
    show_default="four times to an eighth of the configuration's",
)
def magnitude(configuration: str, methods: str | None, flux_e: str | None, **options: Any) -> None:
    """Measure the Strehl ratio of any list of methods against the star's magnitude.

    Each method is tuned at each flux, its settings and the loop gain together, on other turbulence. Methods:
    every estimator by its name (`faintspot estimators` lists them); after the name may follow
    _predicted (its prior is what the loop predicts), _weighted (slopes count by their standard errors),
    _uncorrected (slopes are not divided by the centroid gain), with a laser guide star _filter (weights of
    `window` are the linear matched filter) and _followed (the sodium profile is followed), and then the
    control: +modal, +polc or +kalman in place of the integrator.

    \b
    Examples:
      faintspot loop magnitude --quick
      faintspot loop magnitude diffraction_limit --methods map_predicted,map+kalman --flux-e 20
      faintspot loop magnitude camera_3e --methods brightest,smoothed,tv,ml --flux-e 60,200,640
    """
    from faintspot.experiments.closed_loop.magnitude import run_magnitude

    fluxes = None if flux_e is None else [_number(text) for text in _listed(flux_e)]
    _measure(configuration, "magnitude", run_magnitude, _methods(methods), fluxes, **options)


@_needs_loop
@command.command(short_help="Measure what limits the Strehl ratio.")
@_experiment_options
@option("--methods", metavar="NAMES", help="Methods, with commas.", show_default="brightest,smoothed,tv")
def budget(configuration: str, methods: str | None, **options: Any) -> None:
    """Measure what limits the Strehl ratio, by switching off one term of the error after another.

    At the configuration's own flux, each method is tuned and then runs without photon and read noise, without
    delay of the loop, without what the mirror cannot correct, with its actual centroid gain, and with the
    wavefront's true slopes.

    \b
    Examples:
      faintspot loop budget camera_3e --quick
    """
    from faintspot.experiments.closed_loop.budget import run_budget

    _measure(configuration, "budget", run_budget, _methods(methods), **options)


@needs("loop", "hcipy")
@command.command(short_help="Write what a real-time engine needs, [control] included.")
@click.argument("configuration", metavar="[CONFIG]", default="canary")
@option("--output", "-o", default=".", metavar="FOLDER", help="Folder for faintspot.toml and matrices.")
@option(
    "--control",
    type=click.Choice(["integrator", "modal", "polc", "kalman"]),
    default="integrator",
    help="Control; all but the integrator learn from the simulated loop for up to a minute.",
)
@option("--frame-rate-hz", type=float, metavar="HZ", help="Frame rate.", show_default="CONFIG")
def engine(configuration: str, output: str, control: str, frame_rate_hz: float | None) -> None:
    """Write faintspot.toml with which `faintspot realtime run --close-loop` closes this loop.

    Layout, calibration, PSF and [control] with interaction matrix, reference slopes and centroid gain, from
    the simulation. Estimator, settings and whatever else faintspot.toml says already stay, such as what
    `faintspot loop tune` has chosen; without an estimator it gets the 20 brightest pixels.

    \b
    Examples:
      faintspot loop engine canary -o bench
      faintspot loop engine faintspot-loop.toml --control kalman
    """
    from faintspot.loop.simulation.configuration.configuration import load_loop
    from faintspot.loop.simulation.engine_files import write_engine_files

    loop = load_loop(configuration)
    if frame_rate_hz is not None:
        loop = loop.replace("control", frame_rate_hz=frame_rate_hz)
    path = write_engine_files(loop, output, control)
    click.echo(f"{path} written; next: faintspot realtime run --config {shlex.quote(str(path))} --close-loop")


def _measure(
    configuration: str,
    name: str,
    run: Callable[..., Any],
    *what: Any,
    output: str | None,
    quick: bool,
    overwrite: bool,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Run an experiment with a progress bar, print the summary of its result and write its page."""
    from faintspot.experiments.closed_loop.page import loop_page
    from faintspot.experiments.closed_loop.verdict import LoopResults, loop_summary
    from faintspot.experiments.running import WorkerPool
    from faintspot.loop.simulation.configuration.configuration import load_loop

    loop = load_loop(configuration)
    folder = output or (f"{loop.name}-quick" if quick else loop.name)
    with progress_bar("loop") as advance:
        pool = WorkerPool(workers, advance, lambda text: click.echo(text, err=True), scheduler)
        result = run(loop, folder, *what, quick=quick, pool=pool, overwrite=overwrite)
    click.echo(loop_summary(LoopResults(**{name: result})))
    page = Path(folder) / "report.html"
    loop_page(LoopResults.load(folder)).write(page)
    click.echo(f"{shlex.quote(str(page))}: open it in a browser")


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _methods(text: str | None) -> list[str] | None:
    """Return the methods that are asked for; name those that could use the loop's prediction but do not."""
    from faintspot.experiments.closed_loop.methods import method_kind

    if text is None:
        return None
    names = _listed(text)
    for name in names:
        kind = method_kind(name)
        if kind.estimator.takes_prior and not kind.is_predicted:
            own = kind.estimator.name
            rest = kind.name.removeprefix(own)
            click.echo(f"{name}: without the loop's prediction; {own}_predicted{rest} uses it", err=True)
    return names


def _number(text: str) -> float:
    from faintspot.base.errors import InputError

    try:
        return float(text)
    except ValueError:
        raise InputError(f"--flux-e: expected numbers with commas, got {text!r}") from None
