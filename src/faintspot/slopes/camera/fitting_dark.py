"""Estimated dark level that follows the background of other frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.tables import is_map
from faintspot.base.statistics import MAD_TO_STD
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.sensor.layout import Layout

# Differences from the dark that count, over their scatter and the largest value.
_OTHER_DARK, _ROUNDED = 3.0, 1e-6
_FEWEST_PX = 4  # of a window's side; below, as in quad cells, no pixel shows the background only


def with_fitting_dark(
    calibration: Calibration, layout: Layout, mean: NDArray[np.float64], *, is_wide: bool
) -> tuple[Calibration, str]:
    """Move an estimated dark level to the background of some frames, if that is elsewhere; describe it.

    The background is that of the first and last rows of windows, as in the frames of the layout. A dark that
    is stated stays, but is named where it lies above the frames. Wings of wide spots are no background.

    Parameters
    ----------
    calibration : Calibration
    layout : Layout
    mean : (h, w) array
        Mean of the frames, ADU.
    is_wide : bool
        Whether the wings of spots reach the border of windows.
    """
    if calibration.dark is None or not np.isfinite(mean).any() or min(layout.window) < _FEWEST_PX:
        return calibration, ""
    edges = layout.images(mean - calibration.dark)[:, [0, -1]]
    away = float(np.nanmedian(edges))
    scatter = MAD_TO_STD * float(np.nanmedian(np.abs(edges - away)))
    wings = away > 0 and (is_wide or calibration.dark_is_known)  # or sky, where the dark is known
    if wings or abs(away) <= max(_OTHER_DARK * scatter, _ROUNDED * float(np.nanmax(np.abs(mean)))):
        return calibration, ""
    level = float(np.nanmedian(calibration.dark))
    found = f"the background of these frames is {level + away:.4g} ADU, the dark {level:.4g} ADU"
    if calibration.dark_is_known:
        return calibration, f"{found}: pixels below it have no flux; give the dark of these frames"
    moved = calibration.dark + away if is_map(calibration.dark) else float(f"{level + away:.7g}")
    return replace(calibration, dark=moved), f"{found} as estimated with the layout: the former is taken off"
