"""The three panels of the paper: Strehl ratio against time, r0 and strength."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import FLUX_GREY, METHOD_COLOURS, WIDTH, new_figure, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.texts import Texts
from faintspot.experiments.closed_loop.figures import strehl_axis
from faintspot.experiments.night.analysis import ALL_STRENGTHS, BEST, by_strength, groups, lines
from faintspot.experiments.night.blocks import Night

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

_TEXT = Texts("faintspot.experiments.night")
_REFERENCE_STYLE: dict[str, Any] = {"color": "#000000", "marker": "o"}
_TV_STYLES: dict[str, dict[str, Any]] = {
    ALL_STRENGTHS: {"color": "#8a8a8a", "marker": "^"},
    BEST: {"color": METHOD_COLOURS[0], "marker": "s"},
}
_MARKERS = "Dv<>P"
_POINT: dict[str, Any] = {"ls": "", "ms": 5, "elinewidth": 0.7, "alpha": 0.85}


@styled
def panels_figure(night: Night) -> FigureWithData:
    """Draw Strehl ratio against time, measured r0 and strength, with errors."""
    shown = _shown(night)
    has_r0, has_strength = bool(np.isfinite(night.r0_m).any()), bool((night.strength_e > 0).any())
    names = ["time", *(["r0"] if has_r0 else []), *(["strength"] if has_strength else [])]
    figure = new_figure(0.72 * WIDTH, 4.1 * len(names))
    panels = dict(zip(names, figure.subplots(len(names), squeeze=False)[:, 0], strict=True))
    label = strehl_axis(night.wavelength_m)
    _against(panels["time"], night, night.middle_s / 60, None, shown)
    for number in np.unique(night.set_number)[1:]:
        panels["time"].axvline(
            night.start_s[night.set_number == number][0] / 60, color=FLUX_GREY, lw=1.2, zorder=0
        )
    panels["time"].set(xlabel="time (min)", ylabel=label)
    if has_r0:
        _against(panels["r0"], night, night.r0_m * 100, night.r0_error_m * 100, shown)
        _draw_lines(panels["r0"], night)
        panels["r0"].set(xlabel="measured r0 at 500 nm (cm)", ylabel=label)
    if has_strength:
        _draw_strengths(panels["strength"], night, shown)
        panels["strength"].set(xlabel="strength (e⁻)", ylabel=label)
    for panel in panels.values():
        panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
    handles, texts = panels["time"].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside upper center", ncols=min(3, len(texts)), frameon=False)
    columns = (
        night.middle_s,
        night.strehl,
        night.strehl_error,
        night.r0_m,
        night.r0_error_m,
        night.paired_strehl,
    )
    rows = [
        [night.set_names[night.set_number[b]], night.labels[night.method[b]], night.strength_e[b], *values]
        for b, values in enumerate(zip(*columns, strict=True))
    ]
    values = {"seconds": float(np.median(night.duration_s)), "reference": night.labels[night.reference]}
    return _TEXT.figure("panels", figure, rows, **values)


def _shown(night: Night) -> list[tuple[str, NDArray[np.bool_], dict[str, Any]]]:
    """Return name, blocks and style of what is drawn; each block once, the reference last."""
    found: list[tuple[str, NDArray[np.bool_], dict[str, Any]]] = []
    every = groups(night)
    best = next((group.rows for group in every if group.name == BEST), np.zeros(len(night.strehl), np.bool_))
    others = 0
    for group in every:
        if group.name in _TV_STYLES:
            rows = group.rows & ~best if group.name == ALL_STRENGTHS else group.rows
            name = "TV, other strengths" if group.name == ALL_STRENGTHS and best.any() else group.name
            found.append((name, rows, _TV_STYLES[group.name]))
        else:
            style = {"color": METHOD_COLOURS[1 + others % 3], "marker": _MARKERS[others % len(_MARKERS)]}
            found.append((group.name, group.rows, style))
            others += 1
    reference = night.method == night.reference
    return [*found, (night.labels[night.reference], reference, _REFERENCE_STYLE)]


def _against(
    panel: Axes,
    night: Night,
    x: Floats,
    x_error: Floats | None,
    shown: list[tuple[str, NDArray[np.bool_], dict[str, Any]]],
) -> None:
    for name, rows, style in shown:
        across = None if x_error is None else np.nan_to_num(x_error[rows])
        up = np.nan_to_num(night.strehl_error[rows])
        panel.errorbar(x[rows], night.strehl[rows], up, across, label=name, **_POINT, **style)


def _draw_lines(panel: Axes, night: Night) -> None:
    """Draw the regression lines with their correlation."""
    styles = {**_TV_STYLES, night.labels[night.reference]: _REFERENCE_STYLE}
    for line in lines(night):
        colour = styles.get(line.name, {"color": METHOD_COLOURS[1]})["color"]
        ends = np.array([np.nanmin(night.r0_m), np.nanmax(night.r0_m)])
        text = f"{line.name}: r = {line.correlation:.2f}"
        panel.plot(
            100 * ends, line.intercept + line.slope_per_m.value * ends, color=colour, lw=1.5, label=text
        )
    handles, texts = panel.get_legend_handles_labels()
    drawn = [(handle, text) for handle, text in zip(handles, texts, strict=True) if " r = " in text]
    panel.legend(*zip(*drawn, strict=True), frameon=False, fontsize=10)


def _draw_strengths(
    panel: Axes, night: Night, shown: list[tuple[str, NDArray[np.bool_], dict[str, Any]]]
) -> None:
    """Draw blocks against strength, and the ranges at the height of the reference plus their difference."""
    reference = night.strehl[night.method == night.reference]
    mean, scatter = float(np.nanmean(reference)), float(np.nanstd(reference))
    panel.axhspan(mean - scatter, mean + scatter, color=FLUX_GREY, zorder=0, lw=0)
    panel.axhline(mean, color="black", lw=1, label="mean without TV")
    for _, rows, style in shown:
        chosen = rows & np.isfinite(night.strength_e)
        up = np.nan_to_num(night.strehl_error[chosen])
        panel.errorbar(night.strength_e[chosen], night.strehl[chosen], up, **_POINT, **style)
    ranges = by_strength(night)
    if ranges:
        x = [strength for strength, _ in ranges]
        found = [each.measured for _, each in ranges]
        ends = np.nan_to_num([[e.value - e.low for e in found], [e.high - e.value for e in found]])
        y = [mean + each.value for each in found]
        colour = METHOD_COLOURS[1]
        panel.errorbar(
            x, y, ends, color=colour, marker="s", ms=8, lw=2, capsize=4, label="ranges of strengths"
        )
    panel.legend(frameon=False, fontsize=10)
