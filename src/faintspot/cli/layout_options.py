"""Options of faintspot layout, and what it found, in words."""

import math
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
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.recorded.first_settings import FirstSettings
from faintspot.slopes.sensor.binning import scaled_points
from faintspot.slopes.sensor.found_layout import FoundLayout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, reference_in_words


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


_MOST_NAMED = 12  # sub-apertures in one line
_LARGE_PX = 0.03  # constant error at the pupil's edge


def describe_settings(settings: Settings, layout: Layout, seen: FirstSettings, unit: str) -> list[str]:
    """Describe noise and flux of the spots, and the settings."""
    estimator, reach = settings.estimator, settings.search_range_px
    within = "" if reach is None else f", slopes within {np.max(reach):g} px"
    lines = [
        f"  background noise {plain(seen.noise)} {unit}, flux of a spot {plain(seen.flux)} {unit}",
        f"  {estimator.name}: {estimator.in_words(len(layout), layout.pixels)}{within}",
    ]
    if seen.response < 1:
        lines.append(
            f"  the flux of single frames is too low for full slopes: they show {seen.response:.2f} of the "
            "displacements; `faintspot tune --recording` says what is possible"
        )
    if math.isfinite(seen.systematic_px or math.inf):
        lines.append(
            f"  S-curve: systematic errors up to {seen.systematic_px:.3f} px wherever a spot of "
            f"{seen.fwhm_px:.2g} px lies in its pixels, in simulations of Gaussian spots"
        )
    if seen.at_edge_px > _LARGE_PX:
        lines.append(
            "  spots overlap: where neighbours are missing, slopes are off by up to "
            f"{plain(seen.at_edge_px)} px, the same in all frames; a reference of the same spots takes it off"
        )
    return lines


def describe(output: str, found: FoundLayout, layout: Layout) -> list[str]:
    """Describe the lenslets that were found and those left out."""
    rows, columns = np.ptp(layout.cells, axis=0) + 1
    height, width = layout.window
    lines = [
        f"{output}: {len(layout)} sub-apertures lit of a {layout.geometry} array of {rows} x {columns}, "
        f"pitch {layout.pitch_px:.2f} px, angle {layout.angle_deg:.2f} deg, windows of {height} x {width} px"
    ]
    lines += largest_window_note(layout)
    lines += [f"  doubtful: {doubt}" for doubt in layout.doubts]
    if found.lenslets.doubt:
        lines.append("  (see the picture; try --pitch-px, --pupil)")
    if len(found.cut):
        lines.append(
            f"  {len(found.cut)} lit lenslets at the frame's edge left out, their windows do not fit: "
            f"{_sides(found)}; smaller windows (--pixels) or --move-windows take more"
        )
    lines += _displaced_spots(found)
    if layout.fitted:
        lines.append(f"  {reference_in_words(layout.fitted)}")
    moved = np.abs(np.median(layout.offsets, axis=0))
    if moved.max() > layout.bin:
        lines.append(
            f"  windows moved off the spots by ({moved[0]:.1f}, {moved[1]:.1f}) px: "
            "centres of gravity are worse in them"
        )
    return lines


def _displaced_spots(found: FoundLayout) -> list[str]:
    """Describe spots outside all windows, or far from their lattice."""
    lines = []
    if (count := len(found.outside)) > 0:
        size = np.array(found.layout.frame_shape[::-1])
        depth = np.minimum(found.outside, size - 1 - found.outside).min(axis=1)
        at_edge = np.count_nonzero(depth < 0.5 * found.lenslets.pitch_px)
        where = f", {at_edge} of them at the frame's edge" if at_edge else ""
        spots = "1 lit spot lies" if count == 1 else f"{count} lit spots lie"
        more = "; a smaller --illuminated-fraction takes dim lenslets" if at_edge < count else ""
        lines.append(f"  {spots} outside all windows{where}: see the circles in the picture{more}")
    if (drift := np.linalg.norm(found.lenslets.drifts, axis=1).max()) > 0:
        lines.append(
            f"  the windows follow spots that lie up to {drift:.1f} px from the regular lattice, which stays "
            "the reference"
        )
    return lines


def doubts_of(found: FoundLayout) -> tuple[str, ...]:
    """Return what may be wrong with a layout found in a frame, one sentence each."""
    doubts = [found.lenslets.doubt] if found.lenslets.doubt else []
    for reason, doubtful in (
        ("at their window's edge, which cuts them", found.clipped),
        ("displaced unlike those of all neighbours, or far dimmer", found.unlike),
    ):
        if doubtful.any():
            numbers = np.flatnonzero(doubtful)
            more = ", ..." if len(numbers) > _MOST_NAMED else ""
            named = ", ".join(map(str, numbers[:_MOST_NAMED])) + more
            doubts.append(f"slopes of {named} ({len(numbers)}): spots {reason}")
    return tuple(doubts)


def _sides(found: FoundLayout) -> str:
    """Count the lenslets left out at each side of the frame, such as '7 at small x'."""
    height, width = found.layout.frame_shape
    x, y = found.cut.T
    distances = np.stack([x, width - 1 - x, y, height - 1 - y])
    counts = np.bincount(distances.argmin(axis=0), minlength=4)
    names = ("at small x", "at large x", "at small y", "at large y")
    return ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True) if count)
