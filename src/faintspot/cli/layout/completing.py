"""Complete a calibration by what the frames of `faintspot layout` show: their background, and hot pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.cli.layout import grid as layout_grid
from faintspot.cli.layout.options import plain
from faintspot.slopes.camera.background import overlap, smooth_background, varies
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.sensor.found_layout import FoundLayout
from faintspot.slopes.sensor.known_grid import KnownGrid
from faintspot.slopes.sensor.layout import Layout


def completed(
    calibration: Calibration,
    found: FoundLayout | KnownGrid,
    layout: Layout,
    mean: NDArray[np.float64],
    hot: NDArray[np.int64],
) -> tuple[Calibration, list[str]]:
    """Add the frame's background as dark level where none is known, and hot pixels; describe them."""
    notes = []
    edges = layout.images(mean)[:, [0, -1]]
    if isinstance(found, KnownGrid) and (len(found.unlit) or layout_grid.is_quad_cell(layout)):
        edges = found.unlit if len(found.unlit) else np.zeros(1)
    adu_per_electron = calibration.em_gain / calibration.gain_e_per_adu
    level = float(np.nanmedian(edges)) * adu_per_electron
    spread = float(np.nanmedian(np.abs(edges - np.nanmedian(edges))))
    background = None
    if isinstance(found, FoundLayout):
        levels, background = _background(found, mean)
        if overlap(found.lenslets.pitch_px, found.lenslets.spot_px):
            level = float(np.median(levels)) * adu_per_electron
    if background is not None and calibration.dark is not None:
        low, high = np.quantile(background, [0.02, 0.98]) * adu_per_electron
        notes.append(
            f"  the background varies from {plain(low)} to {plain(high)} ADU beyond the dark, as reflections "
            "and haze do, and is not taken off; without a dark it is"
        )
    elif background is not None:
        estimated = (*calibration.estimated, "dark")
        dark = (background * adu_per_electron).astype(np.float32)
        calibration = replace(calibration, dark=dark, estimated=estimated)
        low, high = np.quantile(dark, [0.02, 0.98])
        notes.append(
            f"  dark {plain(low)} to {plain(high)} ADU, a map: the frame's background, which varies, as "
            "reflections and haze do; --dark gives the camera's own"
        )
    elif calibration.dark is None and level > spread > 0:
        estimated = (*calibration.estimated, "dark")
        calibration = replace(calibration, dark=float(f"{level:.7g}"), estimated=estimated)
        notes.append(
            f"  dark {calibration.dark:g} ADU, the frame's background; --dark gives the camera's own"
        )
    if len(hot):
        estimated = (*calibration.estimated, "bad_pixels")
        calibration = replace(calibration.with_bad_pixels(hot), estimated=estimated)
        notes.append(f"  {len(hot)} hot pixels masked")
    return calibration, notes


def _background(
    found: FoundLayout, mean: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return the background at each spot, and of all pixels, if it varies enough to change slopes."""
    grid = found.lenslets
    background = smooth_background(mean, grid.spots, grid.pitch_px, grid.spot_px)
    column, row = np.clip(np.rint(grid.spots).astype(int), 0, np.array(mean.shape[::-1]) - 1).T
    levels, flux = background[row, column], float(np.median(grid.flux))
    return levels, background if varies(mean, levels, flux, grid.pitch_px, grid.spot_px) else None
