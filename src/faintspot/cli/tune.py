"""faintspot tune: which estimator, with which settings."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from click.core import ParameterSource
from rich import box
from rich.console import Console
from rich.table import Table

from faintspot.base.errors import InputError
from faintspot.camera.calibration import Calibration
from faintspot.cli import tune_loop
from faintspot.cli.layout_options import grid_shape
from faintspot.cli.needs import suggested_slopes
from faintspot.cli.progress import progress_bar
from faintspot.cli.tune_output import check_target, picture_file, wrapped, write_picture
from faintspot.experiments import answer_text
from faintspot.experiments.question import PROFILES, TABLES, read_camera
from faintspot.io.frames import open_frames
from faintspot.pipeline import configuration
from faintspot.sensor.layout import Layout
from faintspot.simulate.photometry import (
    DEFAULT_BAND,
    DEFAULT_QUANTUM_EFFICIENCY,
    DEFAULT_THROUGHPUT,
    ZERO_POINTS,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from faintspot.experiments.answer import Answer
    from faintspot.experiments.question import Question

_MOST_FRAMES, _MOST_PIXELS = 200, 1 << 26
_MOST_NAMES = 3  # of files that are repeated in the suggested command

# Name, type, metavar and help of every option that is also a key of the camera file.
_VALUES: tuple[tuple[str, Any, str | None, str], ...] = (
    (
        "read_noise_e",
        float,
        "E",
        "Read noise, electrons at the camera's output (before the EM gain is divided out).",
    ),
    ("gain_e_per_adu", float, "E/ADU", "Electrons per ADU. Default: 1, or measured in the frames."),
    ("em_gain", float, "G", "Gain of the multiplication register of an EMCCD. Default: 1, none."),
    ("background_e", float, "E", "Photo-electrons of sky and dark current per pixel and frame. Default: 0."),
    ("pixels", int, "N", "Side of a sub-aperture's window."),
    ("fwhm_px", float, "PX", "Width (FWHM) of the optical spot."),
    ("profile", click.Choice(PROFILES), None, "Shape of the spot. Default: diffraction (sinc^2)."),
    ("lenslet_m", float, "M", "Side of a sub-aperture at the telescope's entrance."),
    ("wavelength_nm", float, "NM", "Wavelength of the sensor."),
    ("pixel_scale_arcsec", float, "ARCSEC", "Side of a pixel on the sky."),
    ("r0_m", float, "M", "Fried parameter at 500 nm: tells whether spots are speckled."),
    ("magnitude", float, "MAG", "Of the guide star; needs --lenslet-m and --frame-rate-hz."),
    ("flux_e", float, "E", "Or its flux: detected photons per sub-aperture and frame."),
    ("band", click.Choice(list(ZERO_POINTS)), None, f"Of the magnitude. Default: {DEFAULT_BAND}."),
    (
        "zero_point",
        float,
        "PHOTONS",
        "Photons/s/m^2 of magnitude 0 in the sensor's band. Default: of --band.",
    ),
    ("frame_rate_hz", float, "HZ", "Frames per second."),
    ("throughput", float, "T", f"Of atmosphere, telescope and optics. Default: {DEFAULT_THROUGHPUT:g}."),
    ("quantum_efficiency", float, "Q", f"Default: {DEFAULT_QUANTUM_EFFICIENCY:g}."),
    (
        "search_range_px",
        float,
        "PX",
        "Spots are within plus and minus this. Default: from the frames, or FWHM / 2.",
    ),
    (
        "budget",
        str,
        "R",
        "Slope error allowed, such as 0.1 (px), 0.05arcsec: asks for the limiting magnitude.",
    ),
)


def _values(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of `_VALUES`."""
    for name, kind, metavar, text in reversed(_VALUES):
        flags = [f"--{name.replace('_', '-')}", *(["--photons"] if name == "flux_e" else [])]
        command = click.option(*flags, name, type=kind, metavar=metavar, help=text)(command)
    return command


@click.command(short_help="Say which estimator and settings suit a camera and a star.")
@click.option("--camera", metavar="TOML", help="File of what is known; options count more.")
@click.option("--frames", multiple=True, metavar="FILE", help="Recorded frames, to measure the rest in.")
@click.option("--dark", multiple=True, metavar="FILE", help="Frames without flux.")
@click.option("--key", metavar="NAME", help="Which array to read of files that hold several.")
@_values
@click.option(
    "--grid", metavar="ROWSxCOLUMNS", help="Rows and columns of lenslets, such as 7x7, for the layout."
)
@click.option("--layout", "layout_file", metavar="TOML", help="Configuration with the layout.")
@click.option(
    "--output",
    "-o",
    metavar="TOML",
    default="faintspot.toml",
    show_default=True,
    help="Configuration to write.",
)
@click.option("--picture", metavar="PNG", help="The plot. Default: beside the output, with -tune.png.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of the simulation.")
@click.option("--overwrite", is_flag=True, help="Replace the settings of an existing configuration.")
@tune_loop.loop_options
@click.pass_context
def command(
    context: click.Context,
    /,
    loop: str | None,
    camera: str | None,
    frames: tuple[str, ...],
    dark: tuple[str, ...],
    key: str | None,
    grid: str | None,
    layout_file: str | None,
    output: str,
    picture: str | None,
    seed: int,
    overwrite: bool,
    **options: Any,
) -> None:
    """Say which estimator and settings suit a camera and a star.

    Simulates spots as the camera sees them and tries every estimator on them, those of installed packages
    included. Prints the slope error of each, says how many magnitudes it saves, draws it
    against the star's magnitude, and writes a configuration with the best one's settings.

    What is not known is left out; recorded frames (and darks) tell most of it.

    With --loop it is the closed loop that counts: estimators and control are tuned in quick simulations of it
    and compared by their Strehl ratio, limiting magnitude and the fraction of the sky that they open, with a
    fixed window and an integrator as the baseline. A few minutes; interrupted, the same command goes on.

    \b
    Examples:
      faintspot tune --camera camera.toml --budget 0.1
      faintspot tune --read-noise-e 3 --pixels 16 --fwhm-px 1.8 --flux-e 100
      faintspot tune --frames cube.fits --dark dark.fits --magnitude 11 --lenslet-m 0.5 --frame-rate-hz 500
      faintspot tune --loop diffraction_limit
      faintspot tune --loop mine.toml --magnitudes 8,14 --strehl 0.3
    """
    _check_kind(context)
    if loop is not None:
        tune_loop.tune_for_loop(loop, context.params)
        return
    options = {name: value for name, value in options.items() if name not in tune_loop.NAMES}
    target = Path(output)
    check_target(target, overwrite)
    drawing = picture_file(target, picture)
    given = _given(camera, options)
    known = _sensor(grid, layout_file, target, given)
    given = {**known, **given, **({"layout": known["layout"]} if grid or layout_file else {})}
    with progress_bar("tuning", "steps") as advance:
        question = _question(frames, dark, key, given)
        from faintspot.experiments.tuning import tune

        answer = tune(question, rng=np.random.default_rng(seed), progress=advance)
    console = Console(highlight=False)
    for line in wrapped([answer_text.situation(answer)], console):
        click.echo(line)
    console.print(answer_table(answer))
    heading, *rest = answer_text.recommendation(answer)
    for line in [*wrapped([heading], console), *wrapped(rest, console, "  ")]:
        click.echo(line)
    click.echo("This rests on")
    for line in wrapped(answer_text.foundations(answer), console, "  "):
        click.echo(line)
    _write(answer, target, drawing, frames)


def answer_table(answer: Answer) -> Table:
    """Return the errors of all arms at the star's flux as a table."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("estimator", ratio=1)  # long names wrap, numbers do not
    recorded = ["recorded"] if answer.promises else []
    for heading in ("R (px)", "gain", "rms/gain", *recorded, "outliers", "cost", "mag saved"):
        table.add_column(heading, justify="right", no_wrap=True)
    for result in answer.results:
        found, is_reference = result.statistics, result.arm.name == answer_text.BRIGHTEST
        table.add_row(
            result.arm.label,
            f"{found.error.value:.4f}±{found.error.standard_error:.4f}",
            f"{found.gain.value:.2f}",
            f"{found.corrected_rms.value:.4f}",
            *([f"x {answer.promises[result.arm.name].ratio.value:.2f}"] if recorded else []),
            f"{100 * found.outlier_fraction.value:.1f} %",
            f"{result.arm.estimator.cost:.2f}",
            "" if is_reference else answer_text.short_gain(answer, result.over_brightest),
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
    table.caption_justify = "left"
    return table


def _check_kind(context: click.Context) -> None:
    """Refuse options of the other kind of question."""
    given = {
        name for name in context.params if context.get_parameter_source(name) == ParameterSource.COMMANDLINE
    }
    if "loop" in given:
        wrong = given - {"loop", *tune_loop.NAMES, *tune_loop.SHARED}
        why = "without --loop: what is known of the loop is in its configuration"
    else:
        wrong, why = given & set(tune_loop.NAMES), "with --loop"
    flags = [option.opts[0] for option in context.command.params if option.name in wrong]
    if flags:
        raise InputError(f"{', '.join(sorted(flags))}: expected only {why}")


def _given(camera: str | None, options: dict[str, Any]) -> dict[str, Any]:
    """Return what is known: the options, and the file where they say nothing."""
    chosen = {name: value for name, value in options.items() if value is not None}
    if "magnitude" in chosen and "flux_e" in chosen:
        raise InputError("--magnitude, --flux-e: expected one of them, got both")
    known = {} if camera is None else read_camera(camera)
    if "magnitude" in chosen or "flux_e" in chosen:
        known = {name: value for name, value in known.items() if name not in ("magnitude", "flux_e")}
    return {**known, **chosen}


def _sensor(grid: str | None, layout_file: str | None, target: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Return the layout that was asked for or that the configuration has already, and its calibration."""
    if grid is not None and layout_file is not None:
        raise InputError("--grid, --layout: expected one of them, got both")
    found: dict[str, Any] = {}
    source = layout_file or (str(target) if target.exists() else None)
    if source is not None:
        calibration: Calibration = configuration.load(source, "calibration")
        found["calibration"] = calibration
        default = Calibration()
        for name in ("read_noise_e", "gain_e_per_adu", "em_gain", "background_e"):
            if getattr(calibration, name) != getattr(default, name):
                found[name] = getattr(calibration, name)
        # The target may have no layout yet; a file that was named for its layout must.
        if layout_file is not None or "[layout" in target.read_text(encoding="utf-8"):
            found["layout"] = Layout.load(source)
    if grid is not None:
        found["layout"] = _grid(grid, given)
    return found


def _grid(grid: str, given: dict[str, Any]) -> Layout:
    shape = grid_shape(grid)
    if given.get("pixels") is None:
        raise InputError("--grid: with it, expected --pixels, the side of a sub-aperture's window")
    return Layout.grid(shape, pixels=given["pixels"])


def _question(
    frames: tuple[str, ...], dark: tuple[str, ...], key: str | None, given: dict[str, Any]
) -> Question:
    """Check what is given, and measure the rest in the frames."""
    from faintspot.experiments.question import Question
    from faintspot.experiments.recorded import question_from_frames

    if dark and not frames:
        raise InputError("--dark: expected --frames as well")
    try:
        if not frames:
            return Question(**given)
        given.pop("calibration", None)  # measured
        return question_from_frames(_read(frames, key), _read(dark, None) if dark else None, **given)
    except InputError as error:
        raise InputError(f"{error}{_where(str(error))}") from None


def _where(text: str) -> str:
    """Say how to give the value that an error begins with."""
    name = text.replace("=", ":").partition(":")[0].strip()
    for table, keys in TABLES.items():
        if name in keys:
            return f" (--{name.replace('_', '-')}, or {name} in [{table}] of the --camera file)"
    return ""


def _read(paths: tuple[str, ...], key: str | None) -> NDArray[Any]:
    with open_frames(paths, key=key) as source:
        rows, columns = source.shape
        enough = max(2, min(_MOST_FRAMES, _MOST_PIXELS // (rows * columns)))
        return source.block(0, min(enough, source.n_frames))


def _write(answer: Answer, target: Path, picture: Path | None, frames: tuple[str, ...]) -> None:
    """Write configuration and picture, and say what comes next."""
    answer.save(target)
    click.echo(f"{target}: written")
    if picture is not None:
        from faintspot.experiments.answer_figures import tune_figure

        write_picture(tune_figure(answer), picture)
    if answer.question.layout is None:
        pixels = answer.question.pixels
        click.echo(f"Next: faintspot layout FRAME --pixels {pixels} -o {shlex.quote(str(target))}")
    else:
        names = shlex.join(frames) if 0 < len(frames) <= _MOST_NAMES else "FRAMES"
        click.echo(
            f"Next: faintspot slopes {names} --config {shlex.quote(str(target))} -o {suggested_slopes()}"
        )
