"""Configuration of a run: its file, or a file of telemetry (AOT) with the frames."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, errors_within
from faintspot.io.arrays.fits_units import is_aot
from faintspot.io.locations import split_location
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.sensor.layout import Layout


def configured(
    path: str | Path, frames: Sequence[str | Path], key: str | None
) -> tuple[Configuration, str, NDArray[Any] | None]:
    """Return the configuration, what of it is that of an AOT file, in words, and that file's references."""
    described = Configuration(path) if Path(path).exists() else None
    first = None if described is not None and "layout" in described else _aot_file(frames)
    if first is None:
        return described or Configuration(path), "", None
    from faintspot.io.telemetry.aot_reading import read_aot  # only for such files

    sensor = read_aot(first[0], first[1] or key)
    where = f"{first[0]}: sensor {sensor.name!r}"
    if sensor.layout is None:
        raise InputError(
            f"{where}: expected its sub-apertures (subaperture_mask, mask_offsets, subaperture_size), found "
            f"none; give [layout] in {path}"
        )
    with errors_within(where):
        layout = Layout(**sensor.layout)
    words = ["sub-apertures", *(["reference slopes"] if sensor.reference is not None else [])]
    parts: dict[str, Any] = {"layout": layout}
    if described is None:
        if not sensor.tables:
            command = _layout_command(frames[0], layout, path)
            raise InputError(f"{path}: no such file, and {first[0]} has no settings; `{command}` makes one")
        words.append("settings")
        if sensor.parts is not None:
            stored = configuration.unpacked(sensor.parts)
            parts |= dict(zip(("calibration", "psf", "score"), stored, strict=True))
    tables = sensor.tables if described is None else described.tables
    listed = " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]
    return Configuration(path, tables, **parts), f"{listed} of {first[0]}", sensor.reference


def _aot_file(frames: Sequence[str | Path]) -> tuple[Path, str | None] | None:
    """Return the first file of frames and the key in its name, if it is one of telemetry (AOT)."""
    if isinstance(frames, str | Path) or not frames:
        return None
    try:
        first = split_location(frames[0])
    except InputError:  # whoever opens it says so, after what is wrong with the configuration
        return None
    return first if is_aot(first[0]) else None


def _layout_command(frames: str | Path, layout: Layout, path: str | Path) -> str:
    """Return the command that writes a configuration for a layout whose cells are on a grid."""
    rows, columns = np.ptp(layout.cells, axis=0) + 1
    (top, left), (bottom, right) = layout.corners.min(axis=0), layout.corners.max(axis=0) + layout.window
    is_whole = (top, left, bottom, right) == (0, 0, *layout.frame_shape)
    roi = [] if is_whole else ["--roi", f"{left},{top},{right},{bottom}"]
    words = ["faintspot", "layout", str(frames), "--grid", f"{rows}x{columns}", *roi, "-o", str(path)]
    return shlex.join(words)
