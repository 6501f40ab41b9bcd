"""`faintspot layout --grid`: sub-apertures whose places are known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.cli.layout import options as layout_options
from faintspot.cli.shared.commands import errors_of_options, flag_of
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.sensor.found_layout import KnownGrid, find_illuminated
from faintspot.slopes.sensor.layout import Layout

_QUAD_CELL = 2  # pixels on a side
_ONLY_WITHOUT = ("geometry", "pitch_px", "angle_deg", "centre", "fit", "move_windows")


def illuminated(
    description: str, mean: NDArray[np.float64], grid: str, calibration: Calibration, options: dict[str, Any]
) -> KnownGrid:
    """Return the illuminated sub-apertures of the grid; name the frame in an error."""
    wrong = [flag_of(name) for name in _ONLY_WITHOUT if options[name] not in (None, False, "auto", ())]
    if wrong:
        raise InputError(f"--grid, {', '.join(wrong)}: expected one of them; a grid fills the frame or --roi")
    shape = layout_options.grid_shape(grid)
    kept = {name: value for name, value in options.items() if name not in _ONLY_WITHOUT}
    with errors_of_options(description):
        return find_illuminated(mean, shape, has_dark=calibration.dark is not None, **kept)


def is_quad_cell(layout: Layout) -> bool:
    """Whether windows have two pixels on a side: every estimator is a difference of halves there."""
    return min(layout.window) == _QUAD_CELL


def describe(output: str, found: KnownGrid, layout: Layout, calibration: Calibration) -> list[str]:
    """Describe which sub-apertures are illuminated."""
    height, width = layout.window
    lines = [
        f"{output}: {len(layout)} sub-apertures illuminated of {len(found.layout) + len(found.unlit)}, "
        f"pitch {layout.pitch_px:.4g} px, windows of {height} x {width} px"
    ]
    lines += layout_options.largest_window_note(layout)
    lines += [f"  doubtful: {doubt} (look at the picture)" for doubt in layout.doubts]
    if not is_quad_cell(layout):
        return lines
    lines.append(
        "  quad cells: the settings are the difference of halves over the flux, and no estimator improves "
        "it; its centroid gain follows the size of the spot (faintspot.slopes.training.measure_centroid_gain)"
    )
    if calibration.dark is None:
        lines.append(
            "  the dark level is not known: slopes come out too small where it is not 0; give --dark"
        )
    return lines
