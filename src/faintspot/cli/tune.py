"""faintspot tune and estimators: which estimator, with which settings, and what their options mean."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from rich.console import Console

from faintspot.base.errors import InputError
from faintspot.base.tables import save_tables
from faintspot.cli.commands import SectionedCommand, declared, flag_of, option, suggested_slopes, which_frames
from faintspot.cli.output import (
    check_target,
    picture_file,
    progress_bar,
    results_table,
    wrapped,
    write_picture,
)
from faintspot.experiments.planner import text as answer_text
from faintspot.experiments.planner.question import Question
from faintspot.slopes.camera.calibration import Calibration, binned, binned_calibration, camera_calibration
from faintspot.slopes.estimators.registry import allowed_in_words, estimator_named, estimators, needs_in_words
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.sensor.binning import binned_layout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import side_m

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.table import Table

    from faintspot.experiments.planner.answer import Answer


_MOST_FRAMES, _MOST_PIXELS = 200, 1 << 26
_GIVEN = "Sources"
_MOST_NAMES = 3  # of files that are repeated in the suggested command

_SECTIONS = {"camera": "Camera", "spot": "Spots", "star": "Guide star", "tune": "Search"}


@click.command(cls=SectionedCommand)
@option(
    "--recording", multiple=True, metavar="FILE", help="Recorded frames, to measure the rest.", section=_GIVEN
)
@option("--dark", multiple=True, metavar="FILE", help="Dark frames.", section=_GIVEN)
@which_frames(section=_GIVEN)
@option(
    "--config",
    "-c",
    metavar="TOML",
    help="Configuration with layout, calibration and laser guide star.",
    show_default="that of --output, if there is one",
    section=_GIVEN,
)
@declared(Question, sections=_SECTIONS)
@option("--output", "-o", metavar="TOML", default="faintspot.toml", help="Configuration to write.")
@option("--picture", metavar="PNG", help="Plot to write.", show_default="beside the output, with -tune.png")
@option("--overwrite", is_flag=True, help="Replace the settings of an existing configuration.")
def command(
    recording: tuple[str, ...],
    dark: tuple[str, ...],
    key: str | None,
    time_axis: int | None,
    config: str | None,
    output: str,
    picture: str | None,
    overwrite: bool,
    **options: object,
) -> None:
    """Recommend an estimator and settings for a camera and a star, or for a recording.

    Simulates spots as the camera sees them and tries every estimator on them, those of installed packages
    included. Prints the slope error of each, says how many magnitudes it saves, draws it against the star's
    magnitude, and writes a configuration with the best one's settings. Values that are not given are measured
    in the recording.

    Spots are independent from frame to frame here (open loop). In a closed loop they stay near their
    references, which favours other estimators: `faintspot loop magnitude` compares them there.

    \b
    Examples:
      faintspot tune --read-noise-e 3 --pixels 16 --fwhm-px 1.8 --flux-e 100 --budget 0.1
      faintspot tune --recording cube.fits --dark dark.fits --flux-e 60
    """
    target = Path(output)
    check_target(target, overwrite)
    drawing = picture_file(target, picture, "-tune.png")
    given: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    if "magnitude" in given and "flux_e" in given:
        raise InputError("--magnitude, --flux-e: expected one of them, got both")
    given = {**_sensor(config, target, simulated=not recording), **given}
    camera_layout: Layout | None = given.get("layout")
    factor = 1 if camera_layout is None else camera_layout.bin
    if camera_layout is not None and factor > 1:
        given = _binned(given, camera_layout)
    with progress_bar("tuning", "steps") as advance:
        opened = partial(_read, time_axis=time_axis, factor=factor)
        question = _question(recording, dark, key, given, opened)
        from faintspot.experiments.planner.tuning import tune

        answer = tune(question, rng=np.random.default_rng(1), progress=advance)
    console = Console(highlight=False)
    if factor > 1:
        click.echo(f"{factor} x {factor} pixels are summed: px here are those of binned frames")
    for line in wrapped([answer_text.situation(answer)], console):
        click.echo(line)
    console.print(answer_table(answer))
    heading, *rest = answer_text.recommendation(answer)
    for line in [*wrapped([heading], console), *wrapped(rest, console, "  ")]:
        click.echo(line)
    click.echo("This rests on")
    for line in wrapped(answer_text.foundations(answer), console, "  "):
        click.echo(line)
    answer.save(target)
    if camera_layout is not None and factor > 1:
        _save_in_camera_pixels(answer, target, camera_layout)
    _say_what_is_next(answer, target, drawing, recording)


def answer_table(answer: Answer) -> Table:
    """Return the errors of all methods at the star's flux as a table."""
    recorded = ["recorded"] if answer.promises else []
    headings = ("R (px)", "gain", "rms/gain", *recorded, "outliers", "cost", "mag saved")
    table = results_table("estimator", *headings, wraps=True)
    for result in answer.results:
        found, is_reference = result.statistics, result.method.name == answer_text.BRIGHTEST
        saved = answer_text.gain_in_words(answer, result.over_brightest, sign=True)
        table.add_row(
            result.method.label,
            f"{found.error.value:.4f}±{found.error.standard_error:.4f}",
            f"{found.gain.value:.2f}",
            f"{found.corrected_rms.value:.4f}",
            *([f"x {answer.promises[result.method.name].ratio.value:.2f}"] if recorded else []),
            f"{100 * found.outlier_fraction.value:.1f} %",
            f"{result.method.estimator.cost:.2f}",
            "" if is_reference else saved.replace(" ± ", "±"),
            style="bold" if result is answer.best else None,
        )
    bound = float(answer.bound_px[answer.at_star])
    table.add_row("Cramer-Rao bound", f"{bound:.4f}       ", style="dim")
    table.caption = (
        "R: mean |error| per axis. rms/gain: rms after correcting gain and offset. "
        f"{'recorded: error measured in the recording over the predicted. ' if recorded else ''}"
        "outliers: error above 1 px. cost: 1 is TV with 20 iterations. mag saved: against brightest "
        "pixels, by R."
    )
    return table


def _binned(given: dict[str, Any], layout: Layout) -> dict[str, Any]:
    """Return the values of binned frames for those stated of the camera."""
    factor = layout.bin
    scales = {
        "read_noise_e": factor,
        "background_e": factor**2,
        "pixel_scale_arcsec": factor,
        "fwhm_px": 1 / factor,
        "search_range_px": 1 / factor,
    }
    scaled = {name: value * scales[name] if name in scales else value for name, value in given.items()}
    if (pixels := given.get("pixels")) is not None:
        scaled["pixels"] = pixels // factor
    if "calibration" in given:
        scaled["calibration"] = binned_calibration(given["calibration"], factor, layout.frame_shape)
    budget = str(given.get("budget", "")).removesuffix("px")
    with suppress(ValueError):  # none, in another unit, or refused by the question
        scaled["budget"] = float(budget) / factor
    return {**scaled, "layout": binned_layout(layout)}


def _sensor(config: str | None, target: Path, *, simulated: bool) -> dict[str, Any]:
    """Return what a configuration states of the sensor, or the target where it exists."""
    found: dict[str, Any] = {}
    source = config or (str(target) if target.exists() else None)
    if source is None:
        return found
    described = configuration.Configuration(source)
    calibration = described.calibration
    # The target may have no layout yet; a file that was named for its layout must.
    if config is not None or "layout" in described:
        found["layout"] = described.layout
    found["calibration"] = calibration
    default = Calibration()
    if calibration.read_noise_e is not None and "read_noise_e" not in calibration.estimated:
        found["read_noise_e"] = calibration.typical_read_noise_e
    for name in ("gain_e_per_adu", "em_gain", "background_e"):
        if getattr(calibration, name) != getattr(default, name):
            found[name] = getattr(calibration, name)
    laser, layout = described.laser, found.get("layout")
    if simulated and layout is not None and laser is not None and laser.at_m is not None:
        side = side_m(layout.cells, layout.subaperture_m, layout.diameter_m)
        found |= {"laser": laser, "pixel_scale_arcsec": layout.pixel_scale_arcsec, "subaperture_m": side}
    return found


def _question(
    frames: tuple[str, ...],
    dark: tuple[str, ...],
    key: str | None,
    given: dict[str, Any],
    read: Callable[..., NDArray[Any]],
) -> Question:
    """Check what is given, and measure the rest in the frames."""
    from faintspot.experiments.planner.recorded import question_from_frames

    if dark and not frames:
        raise InputError("--dark: expected --recording as well")
    try:
        if not frames:
            return Question(**given)
        given.pop("calibration", None)  # measured
        darks = read(dark, None) if dark else None
        return question_from_frames(read(frames, key), darks, **given)
    except InputError as error:
        if error.name not in Question.declared():
            raise
        raise InputError(
            f"{error.expected} ({flag_of(error.name)})", name=error.name, value=error.value
        ) from None


def _read(paths: tuple[str, ...], key: str | None, *, time_axis: int | None, factor: int) -> NDArray[Any]:
    """Return the first frames of files, binned by a factor."""
    from faintspot.io.frames import open_frames

    with open_frames(paths, key=key, time_axis=time_axis) as source:
        rows, columns = source.shape
        enough = max(2, min(_MOST_FRAMES, _MOST_PIXELS // (rows * columns)))
        block = source.block(0, min(enough, source.n_frames))
    return block if factor == 1 else binned(block, factor)


def _save_in_camera_pixels(answer: Answer, target: Path, layout: Layout) -> None:
    """Replace layout, settings and calibration of binned frames by those of the camera."""
    calibration = camera_calibration(answer.calibration, layout.bin)
    for item in (layout, answer.best.settings.magnified(layout.bin), calibration):
        configuration.save(target, item)
    if answer.promise is not None:
        table = answer.promise.to_table()
        scaled = {name: layout.bin * value for name, value in table.items() if name.endswith("_px")}
        save_tables(target, {"promise": {**table, **scaled}})


def _say_what_is_next(answer: Answer, target: Path, picture: Path | None, frames: tuple[str, ...]) -> None:
    """Write the picture, and say what comes next."""
    click.echo(f"{target}: written")
    if picture is not None:
        from faintspot.experiments.planner.text import tune_figure

        write_picture(tune_figure(answer), picture)
    if answer.question.layout is None:
        pixels = answer.question.pixels
        click.echo(f"Next: faintspot layout FRAME --pixels {pixels} -o {shlex.quote(str(target))}")
    else:
        names = shlex.join(frames) if 0 < len(frames) <= _MOST_NAMES else "FRAMES"
        click.echo(
            f"Next: faintspot slopes {names} --config {shlex.quote(str(target))} -o {suggested_slopes()}"
        )


@click.command()
@click.argument("name", required=False)
def list_estimators(name: str | None) -> None:
    """List all estimators, those of installed packages included, or the options of the named one.

    \b
    Examples:
      faintspot estimators
      faintspot estimators tv
    """
    from rich.table import Table

    from faintspot.slopes.pipeline.settings import SharedOptions

    table = Table(box=None, pad_edge=False)
    if name is None:
        for heading in ("name", "method", "requires"):
            table.add_column(heading)
        for own, kind in estimators().items():
            table.add_row(own, kind.method or kind.label, needs_in_words(kind))
    else:
        kind = estimator_named(name)
        for heading in ("option", "default", "allowed", "meaning"):
            table.add_column(heading)
        for owner in (kind, SharedOptions):
            defaults = owner.defaults()
            for option, declared in owner.declared().items():
                default = "" if defaults[option] is None else str(defaults[option])
                table.add_row(option, default, allowed_in_words(declared), declared.meaning)
    Console().print(table)
