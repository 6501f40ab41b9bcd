"""The figures of interleaved observations: the paper's three panels, paired differences, r0."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.compare.statistics import paired_mean
from faintspot.loop.analysis import (
    BEST_STRENGTHS,
    NO_TV,
    TV,
    TV_BEST,
    Measurements,
    differences_by_strength,
    paired_differences,
    regression_lines,
)
from faintspot.loop.figures import strehl_axis
from faintspot.report.drawing import GREY, LIGHT_GREY, WIDTH, new_figure, styled
from faintspot.report.figure_data import FigureWithData

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe & Ito (2008) and a grey; the shape of the marker tells them apart as well.
_GROUP_STYLES = {NO_TV: ("#0072B2", "o"), TV: ("#767676", "^"), TV_BEST: ("#D55E00", "s")}
_GAP_S = 2.0  # between sets on the axis of time

Floats = NDArray[np.float64]


def interleaved_figures(table: Measurements, wavelength_m: float) -> Iterator[FigureWithData]:
    """Yield the figures of interleaved observations."""
    yield strehl_figure(table, strehl_axis(wavelength_m))
    yield differences_figure(table)
    if np.isfinite(table.r0_m).any():
        yield seeing_figure(table)


@styled
def strehl_figure(table: Measurements, label: str) -> FigureWithData:
    """Draw the paper's three panels: Strehl against time, against r0 and against strength."""
    figure = new_figure(WIDTH, 9.4)
    panels = figure.subplot_mosaic([["time", "time"], ["r0", "strength"]])
    start = _starts(table)
    time = table.time_s + start[table.set_number]
    for name in (TV, TV_BEST, NO_TV):
        chosen = table.group(name) if name != TV else table.group(TV) & ~table.group(TV_BEST)
        style = _marker(name)
        panels["time"].plot(time[chosen], table.strehl[chosen], label=_legend_name(name), **style)
        panels["r0"].plot(100 * table.r0_m[chosen], table.strehl[chosen], **style)
        if name != NO_TV:
            panels["strength"].plot(table.strength_e[chosen], table.strehl[chosen], **style)
    _name_sets(panels["time"], table, start)
    panels["time"].set(xlabel="time, sets one after the other (s)", ylabel=label)
    panels["time"].set_ylim(top=1.13 * table.strehl.max())
    _draw_regression(panels["r0"], table)
    panels["r0"].set(xlabel="r0 at 500 nm from pseudo-open-loop slopes (cm)", ylabel=label)
    _draw_means(panels["strength"], table)
    panels["strength"].set(xlabel="strength of the denoising (e⁻)", ylabel=label)
    for panel in panels.values():
        panel.set_ylim(bottom=0)
    handles, names = panels["time"].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False)
    caption = (
        "One point for each measurement. Straight lines: least squares through the points of each group "
        "with their correlation r. Right: points as on the left; line: means over ranges of strengths; "
        "band: mean of the measurements without TV and its standard error, which the drift of r0 widens."
    )
    return FigureWithData("strehl", "Strehl with and without TV", caption, figure, *_measurement_rows(table))


@styled
def differences_figure(table: Measurements) -> FigureWithData:
    """Draw the paired differences from the neighbours without TV, by strength."""
    figure = new_figure(WIDTH * 0.7, 4.6)
    panel = figure.subplots()
    single, denoised = paired_differences(table), table.group(TV)
    panel.axhline(0, color=GREY, lw=1)
    panel.axvspan(*BEST_STRENGTHS, color=LIGHT_GREY, lw=0, zorder=0)
    panel.plot(table.strength_e[denoised], single[denoised], **_marker(TV))
    found = differences_by_strength(table)
    rows = [[r.strength_e, r.difference.value, r.difference.low, r.difference.high, r.count] for r in found]
    strength, value, low, high, _ = np.array(rows, np.float64).reshape(-1, 5).T
    bars = np.nan_to_num([value - low, high - value])
    panel.errorbar(strength, value, bars, fmt="s-", color=_GROUP_STYLES[TV_BEST][0], lw=1.3, capsize=3)
    panel.set(xlabel="strength of the denoising (e⁻)", ylabel="Strehl with TV less Strehl without")
    low_end, high_end = panel.get_ylim()
    panel.set_ylim(max(low_end, -1.0), min(high_end, 1.0))
    caption = (
        "Each measurement less the straight line between those without TV before and after it: what drifts "
        "cancels. Squares: means over ranges of strengths; bars: intervals that hold for all ranges together "
        "with 95 %, where there are enough measurements for one. Grey: strengths 0.6 to 1.1."
    )
    header = ["strength_e", "difference", "low", "high", "measurements"]
    return FigureWithData("differences", "Paired differences by strength", caption, figure, header, rows)


@styled
def seeing_figure(table: Measurements) -> FigureWithData:
    """Draw r0 from the telemetry against the truth of the simulation."""
    figure = new_figure(WIDTH * 0.55, 5.6)
    panel = figure.subplots()
    known = np.isfinite(table.r0_m)
    top = 110 * float(max(np.percentile(table.r0_m[known], 98), table.true_r0_m.max()))
    ends = np.array([0.0, top])
    panel.fill_between(ends, 0.9 * ends, 1.1 * ends, color=LIGHT_GREY, lw=0, label="within 10 %")
    panel.plot(ends, ends, color=GREY, lw=1)
    for name in (TV, TV_BEST, NO_TV):
        chosen = known & (table.group(name) if name != TV else table.group(TV) & ~table.group(TV_BEST))
        panel.plot(
            100 * table.true_r0_m[chosen],
            100 * table.r0_m[chosen],
            label=_legend_name(name),
            **_marker(name),
        )
    panel.set(
        xlim=(0, top),
        ylim=(0, top),
        aspect="equal",
        xlabel="true r0 at 500 nm (cm)",
        ylabel="r0 from pseudo-open-loop slopes (cm)",
    )
    panel.legend(frameon=False, loc="upper left")
    caption = (
        "From the variance of the slopes about their mean over the pupil, against von Karman theory with the "
        "configured outer scale; noise taken out by lagged covariance. A measurement lasts seconds, in which "
        "few independent pieces of turbulence pass: single points scatter, the whole does not. Points beyond "
        "the axes are of a loop that had lost the star."
    )
    return FigureWithData("seeing", "r0 from the telemetry", caption, figure, *_measurement_rows(table))


def _marker(group: str) -> dict[str, Any]:
    colour, marker = _GROUP_STYLES[group]
    return {
        "color": colour,
        "marker": marker,
        "ls": "",
        "ms": 4 if group == TV else 6,
        "mec": "white",
        "mew": 0.4,
    }


def _legend_name(group: str) -> str:
    return "TV, other strengths" if group == TV else group


def _starts(table: Measurements) -> Floats:
    """Return where each set begins on the common axis of time, s."""
    lengths = [
        float(table.time_s[table.set_number == number].max(initial=0.0)) + _GAP_S
        for number in range(len(table.set_names))
    ]
    return np.concatenate([[0.0], np.cumsum(lengths)[:-1]])


def _name_sets(panel: Axes, table: Measurements, start: Floats) -> None:
    ends = [*start[1:], None]
    for name, begin, end in zip(table.set_names, start, ends, strict=True):
        if end is not None:
            panel.axvline(end - _GAP_S / 2, color=GREY, lw=1)
        panel.annotate(
            name,
            (begin, 1.0),
            (0, -14),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            fontsize=10,
        )


def _draw_regression(panel: Axes, table: Measurements) -> None:
    shown = table.r0_m[np.isfinite(table.r0_m)]
    if not len(shown):
        return
    top = float(max(np.percentile(shown, 98), table.true_r0_m.max()))
    for name, line in regression_lines(table).items():
        chosen = table.group(name) & np.isfinite(table.r0_m) & (table.r0_m <= top)
        ends = np.array([table.r0_m[chosen].min(initial=top), table.r0_m[chosen].max(initial=0.0)])
        colour = _GROUP_STYLES[name][0]
        panel.plot(100 * ends, line(ends), color=colour, lw=2, label=f"{name}: r = {line.correlation:.2f}")
    panel.set_xlim(0, 105 * top)
    panel.legend(frameon=False, loc="upper left", fontsize=10)


def _draw_means(panel: Axes, table: Measurements) -> None:
    without = table.strehl[table.group(NO_TV)]
    if len(without):
        error = np.nan_to_num(paired_mean(without).standard_error)
        panel.axhspan(
            without.mean() - error, without.mean() + error, color=_GROUP_STYLES[NO_TV][0], alpha=0.2, lw=0
        )
        panel.axhline(without.mean(), color=_GROUP_STYLES[NO_TV][0], lw=1.3, label=NO_TV)
    rows = differences_by_strength(table)
    panel.plot([row.strength_e for row in rows], [row.strehl for row in rows], color="#000000", lw=1.3)


def _measurement_rows(table: Measurements) -> tuple[list[str], list[list[Any]]]:
    header = ["set", "time_s", "strength_e", "strehl", "r0_m", "true_r0_m", "frames"]
    columns = (table.time_s, table.strength_e, table.strehl, table.r0_m, table.true_r0_m, table.frames)
    names = [table.set_names[number] for number in table.set_number]
    return header, [[name, *row] for name, *row in zip(names, *(c.tolist() for c in columns), strict=True)]
