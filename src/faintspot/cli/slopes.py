"""faintspot slopes: recorded frames in, slopes out."""

import shlex
from pathlib import Path
from typing import Any

import click

from faintspot.base.errors import InputError, MissingExtraError, present
from faintspot.base.flags import SubapertureFlag
from faintspot.base.tables import parse_changes
from faintspot.cli.commands import KEY, REFERENCE, configuration_option, declared, option
from faintspot.cli.output import progress_bar
from faintspot.io.frames import slope_format
from faintspot.io.stored_array import split_location
from faintspot.slopes.recorded.measuring import Choices, Summary, measure_recorded


@click.command()
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@configuration_option("Layout, settings, calibration.")
@option(
    "--output",
    "-o",
    metavar="FILE",
    default="slopes.zarr",
    help="What to write, by its ending: .zarr, .fits, .fits.gz, .npz or .csv.",
)
@option("--estimator", metavar="NAME", help="Instead of that in the configuration; see faintspot estimators.")
@option(
    "--set", "changes", metavar="NAME=VALUE", multiple=True, help="An option of the estimator; several times."
)
@option("--no-denoise", is_flag=True, help="Switch the denoising off: the other method of a comparison.")
@declared(Choices, "unit", "mean_flux", "follow", "keep")
@REFERENCE
@KEY
@option("--threads", type=click.IntRange(1), help="Most threads to use.", show_default="all processors")
@option(
    "--block",
    "block_frames",
    type=click.IntRange(1),
    metavar="FRAMES",
    help="Frames in memory at a time.",
    show_default="32 MB",
)
@option("--overwrite", is_flag=True, help="Replace an output of another run.")
def command(
    frames: tuple[str, ...],
    config: str,
    output: str,
    estimator: str | None,
    changes: tuple[str, ...],
    no_denoise: bool,
    **options: Any,
) -> None:
    """Turn recorded frames into slopes.

    FRAMES are FITS (plain, .gz, .fz), TIFF, PNG, BMP, JPEG, HDF5, MATLAB, .npy, .npz or Zarr, in the order
    given. They are read block by block, so that their size does not matter. Interrupted and started again,
    the command resumes (this needs the extra io): until a file other than a .zarr store is complete, its
    slopes are in OUTPUT.partial.zarr. Of telemetry in the AOT standard the frames of its Shack-Hartmann
    sensor are measured (--key names one of several); where the configuration has no [layout], with the file's
    sub-apertures and reference slopes.

    The output holds x, y (px, or arcsec, from the sub-aperture's centre), flux (e-), valid, flags,
    iterations and bad_pixels of every frame and sub-aperture. Slopes are not valid without flux (x and y are
    0 then), at their search limit, cut by their window, or unlike all neighbours; --keep changes that. A
    .zarr store opens with xarray.open_zarr.

    With --follow the window of each lenslet moves with its spot, and slopes may be larger than a window.
    Lost spots (without flux) and crossing ones (unlike all neighbours) are not valid.

    \b
    Examples:
      faintspot slopes night1.fits night2.fits.gz -c faintspot.toml -o slopes.zarr
      faintspot slopes night1.fits -o plain.zarr --no-denoise
      faintspot slopes night1.fits -o slopes.zarr --set preset=fast
      faintspot slopes night1.fits -o ml.zarr --estimator ml --set model_error=0.1
      faintspot slopes night1.fits -o window.zarr --estimator window --mean-flux
      faintspot slopes aberrated.fits -o followed.zarr --follow
      faintspot slopes cube.npz --key frames -o slopes.csv
    """
    _check_format(output)
    for name in frames:
        split_location(name)  # refuses what is not there
    changed = {} if estimator is None else {"estimator": estimator}
    changed |= parse_changes(changes) if changes else {}
    options = {name: value for name, value in options.items() if value is not None}
    options |= {"changes": changed, "denoise": not no_denoise}
    with progress_bar("slopes") as advance:
        summary = measure_recorded(frames, config, output, progress=advance, **options)
    for line in describe(summary, output):
        click.echo(line)


def _check_format(output: str) -> None:
    """Refuse a format whose package is missing, before the work, and say which one needs none.

    Without zarr, warn that the run cannot be resumed.
    """
    try:
        slope_format(Path(output)).require()
    except MissingExtraError as error:
        raise InputError(f"{error}, or write NumPy's own format: -o {Path(output).stem}.npz") from None
    if not present("zarr"):
        click.echo(
            f"{output}: without zarr an interrupted run starts again; "
            "to resume it, install zarr with pip install 'faintspot[io]'",
            err=True,
        )


def describe(summary: Summary, output: str) -> list[str]:
    """Summarise the run and suggest the next command."""
    if summary.resumed_at == summary.n_frames:
        return [
            f"{output}: complete already ({_count(summary.n_frames, 'frame')}); --overwrite makes it anew",
            *_next_step(output),
        ]
    sizes = _count(summary.n_frames, "frame"), _count(summary.n_subapertures, "sub-aperture")
    lines = [f"{output}: {', '.join(sizes)}"]
    if summary.resumed_at:
        lines.append(
            f"  went on at frame {summary.resumed_at} (counted from 0); the counts are from there on"
        )
    texts = {
        SubapertureFlag.NO_FLUX: "without flux above zero",
        SubapertureFlag.TOO_MANY_BAD_PIXELS: "with too many bad pixels",
        SubapertureFlag.UNLIKE_NEIGHBOURS: "unlike those of all neighbours (probably a wrong spot)",
        SubapertureFlag.SATURATED: "with saturated pixels",
        SubapertureFlag.INFEASIBLE_STRENGTH: "whose noise_std was too strong for the image and was lowered",
        SubapertureFlag.NOT_CONVERGED: "not converged (raise max_iterations or steps)",
        SubapertureFlag.OUTLIER_LIKELY: "so faint that outliers are to be expected",
        SubapertureFlag.AT_SEARCH_LIMIT: "at the limit of search_range_px, or of a spot that its window cuts",
    }
    for flag, text in texts.items():
        count = summary.flag_counts.get(flag, 0)
        if count:
            lines.append(f"  {_count(count, 'slope')} {text} ({100 * count / summary.measured:.3g} %)")
    if summary.repeated_frames:
        lines.append(
            f"  {_count(summary.repeated_frames, 'frame')} repeated: every pixel as in the one before"
        )
    lines += [f"  {note}" for note in summary.notes]
    if not any(summary.flag_counts.values()) and not summary.doubtful:
        lines.append("  every slope is valid, without any flag")
    if summary.bad_frames:
        lines.append(f"  {_count(summary.bad_frames, 'frame')} without any valid slope")
    return lines + _next_step(output)


def _next_step(output: str) -> list[str]:
    """Return the next command; a .csv does not hold what a report needs."""
    return [] if Path(output).suffix.lower() == ".csv" else [f"Next: faintspot report {shlex.quote(output)}"]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
