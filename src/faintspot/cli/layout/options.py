"""Parse the options of `faintspot layout`: numbers, ranges of numbers, and maps of the camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.tables import Tables, is_map
from faintspot.slopes.camera.calibration import Calibration, read_map
from faintspot.slopes.sensor.binning import scaled_points
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW


def binned(options: dict[str, Any], factor: int) -> dict[str, Any]:
    """Return the options that are distances or points in the pixels of binned frames."""
    changed = dict(options)
    for name, value in options.items():
        if value is None:
            continue
        if name == "pitch_px":
            changed[name] = value / factor
        elif name == "pixels":
            if np.any(np.array(value) % factor):
                raise InputError(f"--pixels {value}: expected multiples of --bin {factor}")
            changed[name] = (np.array(value) / factor).tolist()
        elif name == "roi":
            changed[name] = (np.array(value) // factor).tolist()
        elif name == "centre":
            changed[name] = scaled_points(value, 1 / factor).tolist()
        elif name == "pupil":
            radii = [radius / factor for radius in value[2:]]
            changed[name] = [*scaled_points(value[:2], 1 / factor).tolist(), *radii]
    return changed


def grid_shape(text: str) -> tuple[int, int]:
    """Return rows and columns of a text such as 7x7."""
    rows, _, columns = text.lower().partition("x")
    if not (rows.isdecimal() and columns.isdecimal() and int(rows) * int(columns) > 0):
        raise InputError(f"--grid {text}: expected rows and columns of lenslets, such as 7x7")
    return int(rows), int(columns)


def kept(count: int, excluded: list[int] | None) -> NDArray[np.bool_]:
    """Return which of so many sub-apertures are not excluded."""
    if excluded and max(excluded) >= count:
        raise InputError(f"--exclude {max(excluded)}: expected sub-apertures from 0 to {count - 1}")
    kept = ~np.isin(np.arange(count), excluded or [])
    if not kept.any():
        raise InputError(f"--exclude: no sub-aperture is left of {count}")
    return kept


def calibration(target: Path, given: Mapping[str, Any]) -> Calibration:
    """Return the calibration that the configuration states already, with what was given now (None: nothing).

    What an earlier `faintspot layout` estimated from its frames is left out, to be estimated again.
    """
    known = Calibration.load(target) if target.exists() else Calibration()
    defaults = Calibration()
    forgotten = {name: getattr(defaults, name) for name in known.estimated}
    known = replace(known, **forgotten, estimated=())
    maps: dict[str, Callable[[str], Any]] = {
        "dark": partial(number_or_map, "dark"),
        "read_noise_e": partial(number_or_map, "read_noise_e"),
        "flat": flat_field,
        "bad_pixels": partial(read_map, "bad_pixels"),
    }
    changes = {
        name: maps[name](value) if name in maps else value
        for name, value in given.items()
        if value is not None
    }
    return replace(known, **changes)


def kept_calibration(calibration: Calibration, given: Mapping[str, object]) -> list[str]:
    """Return a line on what an existing configuration states and was not given now."""
    kept = [
        f"{name} {plain(value) if not is_map(getattr(calibration, name)) else 'map'}"
        for name, value in calibration.to_table().items()
        if given.get(name) is None
    ]
    return [f"  kept as the configuration states: {', '.join(kept)}"] if kept else []


def optics(target: Path, given: Mapping[str, float | None]) -> dict[str, Any]:
    """Return the scales of a layout that were given, or else those that the configuration has already."""
    known = Tables(target).tables.get("layout", {}) if target.exists() else {}
    return {name: known.get(name) if value is None else value for name, value in given.items()}


def largest_window_note(layout: Layout) -> list[str]:
    """Return a line that says so where windows are limited and leave out much of a sub-aperture."""
    side = max(layout.window)
    most = LARGEST_WINDOW * layout.bin
    if side < most or layout.pitch_px is None or layout.pitch_px < side + 1:
        return []
    return [
        f"  windows stop at {most} px, of a pitch of {layout.pitch_px:.0f} px: spots farther than "
        f"{most // 2} px from their centre are missed; --bin {layout.bin + 1} allows larger ones"
    ]


def number_or_map(name: str, text: str) -> Any:
    """Return a value of the calibration: a number, or the map in a file."""
    return float(text) if is_number(text) else read_map(name, text)


def is_number(text: str) -> bool:
    """Return whether a value is a number; otherwise it names a file."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def flat_field(text: str) -> NDArray[np.float64]:
    """Return the relative response of the pixels: a frame, or the mean of several, divided by its mean."""
    flat = read_map("flat", text)
    usable = np.isfinite(flat) & (flat > 0)
    if not usable.any():
        raise InputError(f"{text}: expected a flat field, no pixel is above 0")
    return np.asarray(flat / flat[usable].mean())


def plain(value: object) -> str:
    """Format a number to three digits, never as 6.7e+02; return other values unchanged."""
    if not isinstance(value, float | int):
        return str(value)
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")
