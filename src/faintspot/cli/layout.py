"""faintspot layout: find the sub-apertures in a frame."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from faintspot import configuration
from faintspot.errors import InputError, MissingExtraError
from faintspot.estimate.noise import pixel_noise, suggested_strength
from faintspot.io.frames import FrameSource, open_frames, read_array
from faintspot.pipeline import SlopePipeline
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.hot_pixels import find_hot_pixels
from faintspot.sensor.layout import GEOMETRIES, Layout
from faintspot.sensor.windows import FoundLayout, find_layout
from faintspot.settings import Settings

_MOST_FRAMES = 200  # averaged to find the spots
_FIRST_FRAMES = 20  # measured for the settings


@click.command(short_help="Find the sub-apertures in a frame and write a configuration.")
@click.argument("frames", nargs=-1, required=True, metavar="FRAME...")
@click.option(
    "--output",
    "-o",
    metavar="TOML",
    default="faintspot.toml",
    show_default=True,
    help="Configuration to write.",
)
@click.option(
    "--picture", metavar="PNG", help="Where to draw the frame and the grid. Default: beside the output."
)
@click.option(
    "--geometry",
    type=click.Choice(["auto", *GEOMETRIES]),
    default="auto",
    show_default=True,
    help="How the lenslets are packed.",
)
@click.option("--pitch", type=float, metavar="PX", help="Distance of neighbouring lenslets, if you know it.")
@click.option(
    "--pixels", type=int, metavar="N", help="Side of a window. Default: the largest without overlap."
)
@click.option(
    "--move-windows",
    is_flag=True,
    help="Move all windows alike, off their spots, to save lenslets at the frame's edge.",
)
@click.option("--dark", metavar="FILE|ADU", help="Dark frame, as FILE or FILE:ARRAY, or a number of ADU.")
@click.option(
    "--gain", type=float, metavar="E/ADU", help="Electrons per ADU. Default: 1, frames in electrons."
)
@click.option(
    "--mask-hot-pixels",
    is_flag=True,
    help="Enter isolated bright pixels as bad pixels. Not for spots sharper than Nyquist sampling.",
)
@click.option("--key", metavar="NAME", help="Which array to read of files that hold several.")
@click.option(
    "--overwrite",
    is_flag=True,
    help="Replace the layout and settings of an existing configuration; its calibration stays.",
)
def command(
    frames: tuple[str, ...],
    output: str,
    picture: str | None,
    geometry: str,
    pitch: float | None,
    pixels: int | None,
    move_windows: bool,
    dark: str | None,
    gain: float | None,
    mask_hot_pixels: bool,
    key: str | None,
    overwrite: bool,
) -> None:
    """Find the sub-apertures in a frame and write a configuration.

    FRAME is a file with spots, from one frame to many of the same field (the first 200 are averaged). Square
    and hexagonal lenslet arrays are found without hints: pitch, angle, offset, and which lenslets are lit. A
    picture shows the frame with the windows that were found: look at it.

    A configuration with settings but no layout, as `faintspot tune` writes it without frames, keeps them.
    Else the settings written beside the layout are a start: the strength noise_std is taken from the frame's
    background noise and flux, which must be typical of the frames to come.

    \b
    Examples:
      faintspot layout flat_wavefront.fits -o faintspot.toml
      faintspot layout cube.npz --dark dark.fits --gain 1.9 --pixels 16
    """
    target = Path(output)
    keeps_settings = configuration.has(target, "settings") and not configuration.has(target, "layout")
    if target.exists() and not overwrite and not keeps_settings:
        raise InputError(f"{output}: exists already; --overwrite replaces its layout and settings")
    with open_frames(frames, key=key) as source:
        calibration = _calibration(target, dark, gain)
        mean = _mean_frame(source, calibration)
        hot = find_hot_pixels(mean) if mask_hot_pixels else np.empty((0, 2), int)
        mean[tuple(hot.T)] = np.nan
        bad = np.isnan(mean)
        try:
            found = find_layout(
                np.where(bad, 0, mean),
                geometry=geometry,
                pitch_px=pitch,
                pixels=pixels,
                bad_pixels=bad,
                move_windows=move_windows,
            )
        except InputError as error:
            text = str(error).replace("pitch_px", "--pitch PX")
            raise InputError(f"{source.description}: {text}") from None
        layout = found.layout
        first = source.block(0, min(_FIRST_FRAMES, source.n_frames))
    calibration, notes = _completed(calibration, layout, mean, hot)
    settings, noise, flux = _first_settings(layout, calibration, first)
    if keeps_settings:
        settings = configuration.load(target, "settings")
        notes.append(f"  the settings that {output} has are kept")
    drawn = _draw(np.where(bad, np.nanmedian(mean), mean), layout, picture, target)
    for item in (layout, settings, calibration):
        configuration.save(target, item)
    for line in [*_describe(output, found, settings, noise, flux), *notes]:
        click.echo(line)
    if calibration.gain_e_per_adu == 1.0:
        click.echo("  one electron per ADU assumed; give --gain if your camera has another")
    click.echo(f"  {drawn}")
    arguments = [*frames, *(["--key", key] if key else []), "--config", output, "-o", "slopes.zarr"]
    click.echo(f"Next: faintspot slopes {shlex.join(arguments)}")


def _describe(output: str, found: FoundLayout, settings: Settings, noise: float, flux: float) -> list[str]:
    """Say in a few lines what was found, and what was left out."""
    layout = found.layout
    rows, columns = layout.cells.max(axis=0) + 1
    height, width = layout.window
    lines = [
        f"{output}: {len(layout)} sub-apertures lit of a {layout.geometry} array of {rows} x {columns}, "
        f"pitch {layout.pitch_px:.2f} px, angle {layout.angle_deg:.2f} deg, windows of {height} x {width} px",
        f"  background noise {noise:.2g} e-, median flux {flux:.4g} e-: noise_std {settings.noise_std}",
    ]
    if len(found.cut):
        lines.append(
            f"  {len(found.cut)} lit lenslets at the frame's edge left out, their windows do not fit: "
            f"{_sides(found)}; smaller windows (--pixels) or --move-windows take more"
        )
    moved = np.abs(np.median(layout.offsets, axis=0))
    if moved.max() > 1:
        lines.append(
            f"  windows moved off the spots by ({moved[0]:.1f}, {moved[1]:.1f}) px: "
            "centres of gravity are worse in them"
        )
    return lines


def _sides(found: FoundLayout) -> str:
    """Say at which sides of the frame lenslets were left out, such as '7 left, 8 below'."""
    height, width = found.layout.frame_shape
    x, y = found.cut.T
    distances = np.stack([x, width - 1 - x, y, height - 1 - y])
    counts = np.bincount(distances.argmin(axis=0), minlength=4)
    names = ("at small x", "at large x", "at small y", "at large y")
    return ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True) if count)


def _mean_frame(source: FrameSource, calibration: Calibration) -> NDArray[np.float64]:
    """Mean of the first frames in electrons, of what is finite; NaN where nothing is."""
    total, count = np.zeros(source.shape), np.zeros(source.shape, int)
    for _, block in source.blocks(0, min(_MOST_FRAMES, source.n_frames), _FIRST_FRAMES):
        finite = np.isfinite(block)
        total += np.where(finite, block, 0).sum(axis=0, dtype=np.float64)
        count += finite.sum(axis=0)
    if not count.any():
        raise InputError(f"{source.description}: expected a frame with spots, every pixel is NaN or infinite")
    dark, electrons_per_adu = calibration.maps(source.shape)
    mean = np.divide(total, count, where=count > 0, out=np.full(source.shape, np.nan))
    electrons: NDArray[np.float64] = (mean - dark) * electrons_per_adu
    return electrons


def _draw(frame: NDArray[Any], layout: Layout, picture: str | None, target: Path) -> str:
    """Draw frame and windows and say where; without matplotlib only a picture that was asked for fails."""
    path = picture or str(target.with_suffix(".png"))
    try:
        from faintspot.report import layout_picture

        layout_picture(frame, layout, path)
    except MissingExtraError as error:
        if picture is not None:
            raise
        return f"no picture: {error}"
    return f"picture: {path}"


def _calibration(target: Path, dark: str | None, gain: float | None) -> Calibration:
    """The calibration that the configuration has already, with what was given now."""
    calibration: Calibration = configuration.load(target, "calibration") if target.exists() else Calibration()
    if gain is not None:
        calibration = replace(calibration, gain_e_per_adu=gain)
    if dark is None:
        return calibration
    try:
        return replace(calibration, dark=float(dark))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        return replace(calibration, dark=read_array(dark))


def _completed(
    calibration: Calibration, layout: Layout, mean: NDArray[np.float64], hot: NDArray[np.int64]
) -> tuple[Calibration, list[str]]:
    """Add the frame's background as dark level where none is known, and hot pixels; say so."""
    notes = []
    edges = layout.images(mean)[:, [0, -1]]
    level = float(np.nanmedian(edges)) * calibration.em_gain / calibration.gain_e_per_adu
    spread = float(np.nanmedian(np.abs(edges - np.nanmedian(edges))))
    if np.ndim(calibration.dark) == 0 and calibration.dark == 0.0 and level > spread > 0:
        calibration = replace(calibration, dark=float(f"{level:.4g}"))
        notes.append(
            f"  dark {calibration.dark:g} ADU, the frame's background; --dark gives the camera's own"
        )
    if len(hot):
        known = calibration.bad_pixels
        if known is None:
            known = np.empty((0, 2), int)
        elif known.dtype == np.bool_:
            known = np.argwhere(known)
        calibration = replace(calibration, bad_pixels=np.unique(np.concatenate([known, hot]), axis=0))
        notes.append(f"  {len(hot)} hot pixels masked")
    return calibration, notes


def _first_settings(
    layout: Layout, calibration: Calibration, frames: NDArray[Any]
) -> tuple[Settings, float, float]:
    """Settings to begin with, and the noise (e-) and flux (e-) that they rest on."""
    plain = SlopePipeline(layout, Settings(denoise=False), calibration)
    stages = plain.explain(frames)
    noise = pixel_noise(stages.calibrated)
    flux = float(np.median(stages.slopes.flux))
    strength = float(suggested_strength(noise, max(flux, 0.0), layout.pixels))
    return Settings(noise_std=float(f"{strength:.3g}")), noise, flux
