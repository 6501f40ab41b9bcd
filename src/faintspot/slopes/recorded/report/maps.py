"""The maps and plots over all frames of a report: flux, validity, slopes, iterations, jitter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.drawing import (
    FLUX_GREY,
    GREY,
    METHOD_COLOURS,
    WIDTH,
    limits_of,
    new_figure,
    styled,
)
from faintspot.slopes.recorded.statistics import Floats, Jitter, MeasuredSlopes, SlopesSummary, median
from faintspot.slopes.sensor.drawing import MOST_WITH_GAPS, place_axes, subaperture_map, subaperture_shapes
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_HEIGHT = 5.0
_HISTOGRAM_BINS = 60
ARROWS_WHOLE_PERCENT = 98
"""Percentage of slopes whose arrows are never cut."""
_MOST_SHORT_ARROWS = 400  # of more sub-apertures, arrows within their own could not be seen


@styled
def flux_and_validity(
    methods: Sequence[MeasuredSlopes], summaries: Sequence[SlopesSummary], layout: Layout
) -> Figure:
    """Draw median flux and fraction of valid frames, a row of maps a method; of one frame, flux only."""
    several = methods[0].n_frames > 1
    figure, axes = _panels(len(methods), 2, layout) if several else _panels(1, len(methods), layout)
    limits = limits_of(*(summary.flux_e for summary in summaries), low=0.0)
    for number, (method, summary) in enumerate(zip(methods, summaries, strict=True)):
        panel = axes[number, 0] if several else axes[0, number]
        title = f"{method.name}: {'median ' if several else ''}flux"
        subaperture_map(panel, layout, summary.flux_e, label="flux (e-)", limits=limits, title=title)
        if several:
            percent = 100.0 * summary.valid_frames / method.n_frames
            subaperture_map(
                axes[number, 1],
                layout,
                percent,
                label="valid frames (%)",
                limits=(0, 100),
                title=f"{method.name}: valid frames",
            )
    return figure


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
def iteration_counts(
    methods: Sequence[MeasuredSlopes], summaries: Sequence[SlopesSummary], layout: Layout
) -> Figure:
    """Draw the mean iterations of every sub-aperture (first method) and how often each number occurred."""
    figure, axes = _panels(1, 2, layout)
    limits = limits_of(summaries[0].iterations, low=0.0)
    title = f"{methods[0].name}: {'mean ' if methods[0].n_frames > 1 else ''}iterations"
    subaperture_map(
        axes[0, 0], layout, summaries[0].iterations, label="iterations", limits=limits, title=title
    )
    panel = axes[0, 1]
    most = max(int(method.iterations.max()) for method in methods)
    step = max(1, -(-(most + 1) // _HISTOGRAM_BINS))
    edges = np.arange(0, most + 1 + step, step) - 0.5
    for method, colour in zip(methods, METHOD_COLOURS, strict=False):
        counts = np.histogram(method.iterations[method.valid], edges)[0]
        panel.stairs(100.0 * counts / max(1, counts.sum()), edges, fill=True, color=colour, label=method.name)
    panel.set_xlabel("iterations")
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.set_ylim(top=200)
    panel.set_ylabel("valid measurements (%)")
    panel.set_title("How many iterations it took")
    if len(methods) > 1:
        panel.legend(frameon=False)
    return figure


@styled
def jitter_maps(methods: Sequence[MeasuredSlopes], jitters: Sequence[Jitter], layout: Layout) -> Figure:
    """Draw the jitter of every sub-aperture, one map per method, on one scale."""
    figure, axes = _panels(1, len(methods), layout)
    limits = limits_of(*(item.px for item in jitters), low=0.0)
    for panel, method, item in zip(axes[0], methods, jitters, strict=True):
        title = f"{method.name}: median {median(item.px):.3f} px"
        subaperture_map(panel, layout, item.px, label="jitter (px)", limits=limits, title=title)
    return figure


@styled
def jitter_plot(methods: Sequence[MeasuredSlopes], jitters: Sequence[Jitter]) -> Figure:
    """Draw the jitter of the sub-apertures in order, and one method against another where there are two."""
    pair = len(methods) == 2
    figure = new_figure(WIDTH, _PANEL_HEIGHT)
    axes = figure.subplots(1, 2 if pair else 1, squeeze=False)[0]
    order = np.argsort(jitters[-1].px)
    for method, item, colour in zip(methods, jitters, METHOD_COLOURS, strict=False):
        order = order[item.measured[order]]
        rank = np.arange(1, len(order) + 1)
        axes[0].plot(rank, item.px[order], ".", color=colour, label=f"{method.name}: standard deviation")
        axes[0].plot(
            rank,
            _running_median(item.robust_px[order]),
            "-",
            lw=1.3,
            color=colour,
            label=f"{method.name}: robust",
        )
        axes[0].axhline(median(item.px), color=colour, lw=0.9, ls=":")
    axes[0].set_xlabel(f"sub-apertures, in order of the jitter of {methods[-1].name!r}")
    axes[0].set_ylabel("jitter, rms of x and y (px)")
    axes[0].set_ylim(bottom=0)
    if pair:
        _scatter(axes[1], methods, jitters)
    figure.legend(loc="outside lower center", ncols=5, frameon=False)  # beside the data, never on it
    return figure


def _running_median(values: Floats) -> Floats:
    """Return medians over a sixtieth of the values on both sides: few values stay as they are."""
    reach = len(values) // 120
    padded = np.pad(values, reach, constant_values=np.nan)
    medians: Floats = np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=1)
    return medians


def _scatter(axes: Axes, methods: Sequence[MeasuredSlopes], jitters: Sequence[Jitter]) -> None:
    """Draw the second method's jitter along x against the first's along y."""
    across, up = jitters[1].px, jitters[0].px
    axes.plot(across, up, ".", color=METHOD_COLOURS[1], markersize=7 if len(up) < 500 else 3)
    _, stop = limits_of(across, up, low=0.0)
    stop *= 1.08
    axes.plot([0, stop], [0, stop], color=GREY, lw=1)
    axes.annotate("equal", (0.93 * stop, 0.95 * stop), ha="right", color="#555555")
    axes.plot(
        median(across), median(up), "D", color=METHOD_COLOURS[0], markersize=9, mec="black", label="medians"
    )
    axes.set_xlim(0, stop)
    axes.set_ylim(0, stop)
    axes.set_aspect("equal")
    axes.set_xlabel(f"jitter, {methods[1].name} (px)")
    axes.set_ylabel(f"jitter, {methods[0].name} (px)")
    axes.set_title("Below the line: the first method is steadier", fontsize=12)


def _panels(rows: int, columns: int, layout: Layout) -> tuple[Figure, Any]:
    """Return a figure with panels for maps, as high as the sensor's shape asks for."""
    width, height = np.ptp(subaperture_shapes(layout).reshape(-1, 2), axis=0)
    panel = min(max(0.8 * WIDTH / max(columns, 2) * height / width, 2.5), 6.5) + 0.6
    figure = new_figure(WIDTH if columns > 1 else 0.6 * WIDTH, rows * panel)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _outlines(layout: Layout) -> Any:
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
