"""faintspot slopes: recorded frames in, slopes out."""

from __future__ import annotations

from pathlib import Path

import click

from faintspot.cli.progress import progress_bar
from faintspot.flags import SubapertureFlag
from faintspot.io.frames import read_array
from faintspot.recorded import Summary, measure_recorded


@click.command(short_help="Turn recorded frames into slopes.")
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@click.option(
    "--config", "-c", default="faintspot.toml", show_default=True, help="Layout, settings, calibration."
)
@click.option("--output", "-o", default="slopes.zarr", show_default=True, help=".zarr, .fits, .npz or .csv.")
@click.option("--no-denoise", is_flag=True, help="Switch the denoising off: the other arm of a comparison.")
@click.option("--reference", metavar="FILE", help="Reference positions, (n, 2) px, as FILE or FILE:ARRAY.")
@click.option("--key", metavar="NAME", help="Which array to read of files that hold several.")
@click.option("--threads", type=click.IntRange(1), help="Most threads to use. Default: all processors.")
@click.option(
    "--block", type=click.IntRange(1), metavar="FRAMES", help="Frames in memory at a time. Default: 32 MB."
)
@click.option("--overwrite", is_flag=True, help="Replace an output of another run.")
def command(
    frames: tuple[str, ...],
    config: str,
    output: str,
    no_denoise: bool,
    reference: str | None,
    key: str | None,
    threads: int | None,
    block: int | None,
    overwrite: bool,
) -> None:
    """Turn recorded frames into slopes.

    FRAMES are FITS files (plain, .gz, .fz; images or cubes), .npy, .npz or Zarr, in the order given. They are
    read block by block, so that their size does not matter. Interrupted and started again, the command goes
    on where it stopped.

    The output holds x, y (px from the sub-aperture's centre, 0 where not valid), flux (e-), valid, flags,
    iterations and bad_pixels of every frame and sub-aperture. A .zarr store opens with xarray.open_zarr.

    \b
    Examples:
      faintspot slopes night1.fits night2.fits.gz -c faintspot.toml -o slopes.zarr
      faintspot slopes night1.fits -o plain.zarr --no-denoise
      faintspot slopes cube.npz --key frames -o slopes.csv
    """
    positions = None if reference is None else read_array(reference)
    with progress_bar("slopes") as advance:
        summary = measure_recorded(
            frames,
            config,
            output,
            denoise=not no_denoise,
            reference=positions,
            key=key,
            threads=threads,
            block_frames=block,
            overwrite=overwrite,
            progress=advance,
        )
    for line in describe(summary, output):
        click.echo(line)


def describe(summary: Summary, output: str) -> list[str]:
    """Say in a few lines what the run found and what to do next."""
    if summary.resumed_at == summary.n_frames:
        return [f"{output}: complete already ({summary.n_frames} frames); --overwrite makes it anew"]
    lines = [f"{output}: {summary.n_frames} frames, {summary.n_subapertures} sub-apertures"]
    if summary.resumed_at:
        lines[0] += f" (went on at frame {summary.resumed_at})"
    texts = {
        SubapertureFlag.NO_LIGHT: "slopes without light",
        SubapertureFlag.TOO_MANY_BAD_PIXELS: "slopes with too many bad pixels",
        SubapertureFlag.BAD_PIXELS: "slopes with a few bad pixels, filled from their neighbours",
        SubapertureFlag.SATURATED: "slopes with saturated pixels",
        SubapertureFlag.INFEASIBLE_STRENGTH: "slopes whose strength (noise_std) is above the image's own rms",
        SubapertureFlag.NOT_CONVERGED: "slopes at the iteration limit (max_iterations)",
    }
    for flag, text in texts.items():
        count = summary.flag_counts.get(flag, 0)
        if count:
            lines.append(f"  {count} {text} ({100 * count / summary.measured:.2g} %)")
    if summary.bad_frames:
        lines.append(f"  {summary.bad_frames} frames without any valid slope")
    if Path(output).suffix != ".csv":
        lines.append(f"Next: faintspot report {output}")
    return lines
