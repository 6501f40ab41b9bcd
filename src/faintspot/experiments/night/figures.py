"""The three panels of the paper: Strehl ratio against time, r0 and strength."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.page import FigureWithData
from faintspot.base.report.plots import FLUX_GREY, METHOD_COLOURS, WIDTH, Line, Panel
from faintspot.base.report.texts import Texts
from faintspot.experiments.night.analysis import ALL_STRENGTHS, BEST, by_strength, groups, lines
from faintspot.experiments.night.blocks import Night
from faintspot.experiments.night.paper import PAPER_MEANS
from faintspot.experiments.night.protocol import COUNTS

Floats = NDArray[np.float64]

_TEXT = Texts("faintspot.experiments.night")
_REFERENCE_STYLE: dict[str, object] = {"color": "#000000", "marker": "o"}
_TV_STYLES: dict[str, dict[str, object]] = {
    ALL_STRENGTHS: {"color": "#8a8a8a", "marker": "^"},
    BEST: {"color": METHOD_COLOURS[0], "marker": "s"},
}
_MARKERS = "Dv<>P"
_POINT: dict[str, object] = {"ls": "", "ms": 5, "elinewidth": 0.7, "alpha": 0.85}


def panels_figure(night: Night) -> FigureWithData:
    """Draw Strehl ratio against time, measured r0 and strength, with errors."""
    label, shown = f"Strehl ratio at {night.wavelength_m * 1e6:.3g} µm", _shown(night)
    lowest = float(np.nanmin(night.strehl - np.nan_to_num(night.strehl_error)))
    bottom: dict[str, Any] = {"y": label, "y_range": (min(0.5 * lowest, 1.1 * lowest), None)}
    starts = [night.start_s[night.set_number == number][0] / 60 for number in np.unique(night.set_number)[1:]]
    sets = {start: {"color": FLUX_GREY, "lw": 1.2, "zorder": 0} for start in starts}
    points = [*_points(night, shown, night.middle_s / 60), *_paper_means(night)]
    panels = [Panel(points, "time (min)", at=sets, legend=True, **bottom)]
    if np.isfinite(night.r0_m).any():
        points = _points(night, shown, night.r0_m * 100, night.r0_error_m * 100)
        fits = _regressions(night)
        panels.append(Panel([*_unnamed(points), *fits], "measured r0 at 500 nm (cm)", legend=True, **bottom))
    if night.has_strengths:
        panels.append(_of_strengths(night, shown, bottom))
    values: dict[str, Any] = {
        "seconds": float(np.median(night.duration_s)),
        "reference": night.labels[night.reference],
    }
    values["strengths"] = night.has_strengths
    options: dict[str, Any] = {"width": 0.72 * WIDTH, "columns": 3, "legend": "outside upper center"}
    rows = [[panel] for panel in panels]
    return _TEXT.figure("panels", rows, 4.1 * len(panels), values, **options)


def _shown(night: Night) -> dict[str, tuple[NDArray[np.bool_], dict[str, object]]]:
    """Return blocks and style of what is drawn, by name; each block once, the reference last."""
    every = groups(night)
    best = next((group.rows for group in every if group.name == BEST), np.zeros(len(night.strehl), np.bool_))
    shown: dict[str, tuple[NDArray[np.bool_], dict[str, Any]]] = {}
    others = [group for group in every if group.name not in _TV_STYLES]
    for group in every:
        if group.name == ALL_STRENGTHS and best.any():
            shown["TV, other strengths"] = group.rows & ~best, _TV_STYLES[group.name]
        elif group in others:
            index = others.index(group)
            style = {"color": METHOD_COLOURS[1 + index % 3], "marker": _MARKERS[index % len(_MARKERS)]}
            shown[group.name] = group.rows, style
        else:
            shown[group.name] = group.rows, _TV_STYLES[group.name]
    return shown | {night.labels[night.reference]: (night.method == night.reference, _REFERENCE_STYLE)}


def _points(
    night: Night,
    shown: dict[str, tuple[NDArray[np.bool_], dict[str, object]]],
    x: Floats,
    x_error: Floats | None = None,
) -> list[Line]:
    return [
        Line(
            name,
            x[rows],
            night.strehl[rows],
            night.strehl_error[rows],
            {**_POINT, **style},
            x_error=None if x_error is None else x_error[rows],
        )
        for name, (rows, style) in shown.items()
    ]


def _paper_means(night: Night) -> list[Line]:
    """Return the means of the paper's Table 1 as lines as long as the sets."""
    if not (night.has_strengths and len(night.set_names) == len(PAPER_MEANS)):
        return []
    colours = {"no TV": "#000000", "all strengths": "#8a8a8a", "0.6 to 1.1": METHOD_COLOURS[0]}
    found = []
    for number, means in enumerate(PAPER_MEANS):
        minutes = night.start_s[night.set_number == number][[0, -1]] / 60
        for (name, colour), mean in zip(colours.items(), means, strict=True):
            style, first = {"color": colour, "lw": 1.5, "ls": "--"}, number == 0
            found.append(Line(f"paper, {name}", minutes, [mean, mean], style=style, in_legend=first))
    return found


def _unnamed(points: list[Line]) -> list[Line]:
    return [replace(line, in_legend=False) for line in points]


def _regressions(night: Night) -> list[Line]:
    """Return the regression lines with their correlation."""
    styles = {**_TV_STYLES, night.labels[night.reference]: _REFERENCE_STYLE}
    ends = np.array([np.nanmin(night.r0_m), np.nanmax(night.r0_m)])
    return [
        Line(
            f"{line.name}: r = {line.correlation:.2f}",
            100 * ends,
            line.intercept + line.slope_per_m.value * ends,
            style={"color": styles.get(line.name, {"color": METHOD_COLOURS[1]})["color"], "lw": 1.5},
        )
        for line in lines(night)
    ]


def _of_strengths(
    night: Night, shown: dict[str, tuple[NDArray[np.bool_], dict[str, object]]], bottom: dict[str, Any]
) -> Panel:
    """Return blocks against strength, and the ranges at the height of the reference plus their difference."""
    reference = night.strehl[night.method == night.reference]
    mean, scatter = float(np.nanmean(reference)), float(np.nanstd(reference))
    strengths = night.strength[night.strength > 0]
    across, height = [strengths.min(), strengths.max()], [mean, mean]
    band = Line("mean without TV", across, height, [scatter, scatter], {"color": "black", "lw": 1}, band=True)
    drawn = [band, *_unnamed(_points(night, shown, night.strength))]
    ranges = by_strength(night)
    if ranges:
        found = [each.measured for _, each in ranges]
        ends = [each.value - each.low for each in found], [each.high - each.value for each in found]
        style = {"color": METHOD_COLOURS[1], "marker": "s", "ms": 8, "lw": 2, "capsize": 4}
        middle, y = [strength for strength, _ in ranges], [mean + each.value for each in found]
        drawn.append(Line("ranges of strengths", middle, y, ends, style))
    above = None
    if night.counts_per_e is not None:
        most, in_counts = float(night.counts_per_e.max()), night.strength_unit == COUNTS
        other = ("e⁻", 1 / most) if in_counts else ("counts", most)
        ticks = np.linspace(0, across[1], 5)
        above = ticks, (ticks * other[1]).tolist(), f"strength ({other[0]}, full gain)"
    return Panel(drawn, f"strength ({night.strength_unit})", legend=True, above=above, **bottom)
