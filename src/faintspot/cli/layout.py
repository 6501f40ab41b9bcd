"""faintspot layout: find the sub-apertures in a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.estimate.noise import pixel_noise, suggested_strength
from faintspot.io.frames import open_frames, read_array
from faintspot.pipeline import SlopePipeline
from faintspot.sensor import configuration
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import GEOMETRIES, Layout
from faintspot.sensor.settings import Settings

_MOST_FRAMES = 200  # averaged to find the spots


@click.command(short_help="Find the sub-apertures in a frame and write a configuration.")
@click.argument("frames", nargs=-1, required=True, metavar="FRAME...")
@click.option("--output", "-o", default="faintspot.toml", show_default=True, help="Configuration to write.")
@click.option(
    "--picture", metavar="PNG", help="Where to draw the frame and the grid. Default: beside the output."
)
@click.option("--geometry", type=click.Choice(["auto", *GEOMETRIES]), default="auto", show_default=True)
@click.option("--pitch", type=float, metavar="PX", help="Distance of neighbouring lenslets, if you know it.")
@click.option(
    "--pixels", type=int, metavar="N", help="Side of a window. Default: the largest without overlap."
)
@click.option("--dark", metavar="FILE", help="Dark frame, as FILE or FILE:ARRAY, or a number of ADU.")
@click.option(
    "--gain", type=float, default=1.0, show_default=True, metavar="E/ADU", help="Electrons per ADU."
)
@click.option("--key", metavar="NAME", help="Which array to read of files that hold several.")
@click.option(
    "--overwrite", is_flag=True, help="Replace the layout and settings of an existing configuration."
)
def command(
    frames: tuple[str, ...],
    output: str,
    picture: str | None,
    geometry: str,
    pitch: float | None,
    pixels: int | None,
    dark: str | None,
    gain: float,
    key: str | None,
    overwrite: bool,
) -> None:
    """Find the sub-apertures in a frame and write a configuration.

    FRAME is a file with spots, from one frame to many of the same field (the first 200 are averaged). Square
    and hexagonal lenslet arrays are found without hints: pitch, angle, offset, and which lenslets are lit. A
    picture shows the frame with the windows that were found: look at it.

    The settings written beside the layout are a start: the strength noise_std is taken from the frame's
    background noise and flux, which must be typical of the frames to come.

    \b
    Examples:
      faintspot layout flat_wavefront.fits -o faintspot.toml
      faintspot layout cube.npz --dark dark.fits --gain 1.9 --pixels 16
    """
    target = Path(output)
    if target.exists() and not overwrite:
        raise InputError(f"{output}: exists already; --overwrite replaces its layout and settings")
    with open_frames(frames, key=key) as source:
        block = source.block(0, min(_MOST_FRAMES, source.n_frames))
    calibration = Calibration(dark=_dark(dark), gain_e_per_adu=gain)
    layout = Layout.from_frame(block, geometry=geometry, pitch_px=pitch, pixels=pixels)
    settings, noise, flux = _first_settings(layout, calibration, block)
    for item in (layout, settings, calibration):
        configuration.save(target, item)
    drawing = picture or str(target.with_suffix(".png"))
    from faintspot.report import layout_picture

    layout_picture(np.nanmean(block, axis=0), layout, drawing)
    rows, columns = layout.cells.max(axis=0) + 1
    height, width = layout.window
    click.echo(
        f"{output}: {len(layout)} sub-apertures lit of a {layout.geometry} array of {rows} x {columns}, "
        f"pitch {layout.pitch_px:.2f} px, angle {layout.angle_deg:.2f} deg, windows of {height} x {width}"
    )
    click.echo(
        f"  background noise {noise:.2g} e-, median flux {flux:.4g} e-: noise_std {settings.noise_std}"
    )
    moved = np.abs(np.median(layout.offsets, axis=0))
    if moved.max() > 1:
        click.echo(
            f"  windows moved off the spots by ({moved[0]:.1f}, {moved[1]:.1f}) px, so that those at the "
            "edge are whole; --pixels makes smaller windows"
        )
    if gain == 1.0:
        click.echo("  one electron per ADU assumed; give --gain if your camera has another")
    click.echo(f"  picture: {drawing}")
    click.echo(f"Next: faintspot slopes {' '.join(frames)} --config {output} -o slopes.zarr")


def _dark(dark: str | None) -> Any:
    if dark is None:
        return 0.0
    try:
        return float(dark)
    except ValueError:
        return read_array(dark)


def _first_settings(
    layout: Layout, calibration: Calibration, frames: NDArray[Any]
) -> tuple[Settings, float, float]:
    """Settings to begin with, and the noise (e-) and flux (e-) that they rest on."""
    plain = SlopePipeline(layout, Settings(denoise=False), calibration)
    stages = plain.explain(frames[: min(len(frames), 20)])
    noise = pixel_noise(stages.calibrated)
    flux = float(np.median(stages.slopes.flux))
    strength = float(suggested_strength(noise, max(flux, 0.0), layout.pixels))
    return Settings(noise_std=float(f"{strength:.3g}")), noise, flux
