"""Describe a layout and its settings in lines for the terminal."""

from __future__ import annotations

import math

import numpy as np

from faintspot.cli.layout import options as layout_options
from faintspot.cli.layout.options import plain
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.recorded.first_settings import FirstSettings
from faintspot.slopes.sensor.found_layout import FoundLayout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.window_checks import reference_in_words

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
    lines += layout_options.largest_window_note(layout)
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
