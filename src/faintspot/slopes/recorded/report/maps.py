"""Maps over all frames of a report: flux, validity, slopes, jitter."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.plots import (
    FLUX_GREY,
    GREY,
    METHOD_COLOURS,
    WIDTH,
    limits_of,
    new_figure,
    styled,
)
from faintspot.slopes.recorded.statistics import Jitter, MeasuredSlopes, SlopesSummary, median
from faintspot.slopes.sensor.drawing import (
    MOST_WITH_GAPS,
    Map,
    place_axes,
    subaperture_map,
    subaperture_shapes,
)
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARROWS_WHOLE_PERCENT = 98
"""Percentage of slopes whose arrows are never cut."""
_MOST_SHORT_ARROWS = 400  # of more sub-apertures, arrows within their own could not be seen


@styled
def flux_and_validity(
    methods: Sequence[MeasuredSlopes], summaries: Sequence[SlopesSummary], layout: Layout
) -> Figure:
    """Draw median flux and fraction of valid frames, a row of maps a method; of one frame, flux only."""
    several = methods[0].n_frames > 1
    limits = limits_of(*(summary.flux_e for summary in summaries), low=0.0)
    title = "{}: median flux" if several else "{}: flux"
    pairs = list(zip(methods, summaries, strict=True))
    flux = [Map(summary.flux_e, "flux (e-)", title.format(method.name), limits) for method, summary in pairs]
    if not several:
        return _maps(layout, [flux])
    percent = [100.0 * summary.valid_frames / method.n_frames for method, summary in pairs]
    names = [f"{method.name}: valid frames" for method in methods]
    valid = [
        Map(values, "valid frames (%)", name, (0, 100)) for values, name in zip(percent, names, strict=True)
    ]
    return _maps(layout, list(zip(flux, valid, strict=True)))


@styled
def slope_arrows(
    methods: Sequence[MeasuredSlopes], summaries: Sequence[SlopesSummary], layout: Layout
) -> Figure:
    """Draw the mean slope of every sub-aperture, one panel per method, all at one scale.

    Those longer than `longest_arrow` are cut to that length and drawn black.
    """
    figure, axes = _panels(1, len(methods), layout)
    longest, _ = longest_arrow(summaries)
    key = _round_length(longest)
    pitch = layout.pitch_px or max(layout.window)
    length, width = (0.6, 0.004) if len(layout) <= _MOST_SHORT_ARROWS else (2.0, 0.0015)
    for panel, method, summary, colour in zip(axes[0], methods, summaries, METHOD_COLOURS, strict=False):
        if len(layout) <= MOST_WITH_GAPS:  # of more, outlines would hide the arrows
            panel.add_collection(_outlines(layout))
        place_axes(panel, layout)
        finite = np.isfinite(summary.x_px)
        slopes = np.stack([summary.x_px[finite], summary.y_px[finite]])
        long = np.hypot(*slopes)
        slopes *= np.minimum(1.0, longest / np.maximum(long, longest))
        arrows = panel.quiver(
            *layout.centres[finite].T,
            *slopes,
            color=np.where(long > longest, "black", colour),
            angles="xy",
            scale_units="xy",
            scale=longest / (length * pitch),
            width=width,
        )
        panel.quiverkey(
            arrows, 0.87, -0.1, key, f"{key:g} px", labelpos="E", coordinates="axes", color=colour
        )
        panel.plot(*layout.centres[~finite].T, "x", color=GREY, markersize=5)
        panel.set_title(f"{method.name}: {'mean slope' if method.n_frames > 1 else 'slope'}", loc="left")
    return figure


@styled
def jitter_maps(methods: Sequence[MeasuredSlopes], jitters: Sequence[Jitter], layout: Layout) -> Figure:
    """Draw the jitter of every sub-aperture, one map per method, on one scale."""
    limits = limits_of(*(item.px for item in jitters), low=0.0)
    titles = [
        f"{method.name}: median {median(item.px):.3f} px"
        for method, item in zip(methods, jitters, strict=True)
    ]
    maps = [Map(item.px, "jitter (px)", title, limits) for item, title in zip(jitters, titles, strict=True)]
    return _maps(layout, [maps])


def _maps(layout: Layout, rows: Sequence[Sequence[Map]]) -> Figure:
    figure, axes = _panels(len(rows), len(rows[0]), layout)
    for panel, shown in zip(axes.flat, chain(*rows), strict=True):
        subaperture_map(panel, layout, shown)
    return figure


def _panels(rows: int, columns: int, layout: Layout) -> tuple[Figure, Any]:
    """Return a figure with panels for maps, as high as the sensor's shape asks for."""
    width, height = np.ptp(subaperture_shapes(layout).reshape(-1, 2), axis=0)
    panel = min(max(0.8 * WIDTH / max(columns, 2) * height / width, 2.5), 6.5) + 0.6
    figure = new_figure(WIDTH if columns > 1 else 0.6 * WIDTH, rows * panel)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _outlines(layout: Layout) -> object:
    from matplotlib.collections import PolyCollection

    return PolyCollection(list(subaperture_shapes(layout)), facecolors="#f6f6f6", edgecolors=FLUX_GREY)


def longest_arrow(summaries: Sequence[SlopesSummary]) -> tuple[float, int]:
    """Return the length, px, at which arrows are cut, and how many are longer.

    It is a percentile, so that a few wild slopes do not make all others too short to be seen; lengths within
    half of it more are left as they are.
    """
    lengths = np.concatenate([np.hypot(summary.x_px, summary.y_px) for summary in summaries])
    lengths = lengths[np.isfinite(lengths)]
    usual = float(np.percentile(lengths, ARROWS_WHOLE_PERCENT)) if lengths.size else 0.0
    if usual <= 0:
        return float(lengths.max(initial=0.0)) or 1.0, 0
    longest = min(float(lengths.max()), 1.5 * usual)
    return longest, int(np.count_nonzero(lengths > longest))


def _round_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
