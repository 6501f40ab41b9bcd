"""The pictures of a recorded night: latencies, and methods in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import GREY, METHOD_COLOURS, WIDTH, new_figure, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.base.report.texts import Texts
from faintspot.engine.telemetry.numbers import MethodDifference, method_names
from faintspot.io.telemetry.recording import Telemetry

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TEXT = Texts("faintspot.slopes.recorded")
_BINS = 80
# Points of the course in time, frames in each, and so many points that they are drawn as dots.
_MOST_TIMES, _FEWEST_TOGETHER, _FEW_TIMES = 400, 50, 20


@styled
def latency_figure(telemetry: Telemetry) -> FigureWithData:
    """Draw how often each latency occurred, by method, and its course in time."""
    figure = new_figure(WIDTH, 4.6)
    left, right = figure.subplots(1, 2)
    latency = 1e6 * telemetry.latency_s
    low, high = float(latency.min()), float(latency.max())
    edges = np.geomspace(max(low, 0.1), max(high, low + 1, 1.0) * 1.001, _BINS + 1)
    rows = []
    for index, (method, name) in enumerate(
        zip(np.unique(telemetry.method), method_names(telemetry), strict=True)
    ):
        counts = np.histogram(latency[telemetry.method == method], edges)[0]
        left.stairs(counts, edges, color=METHOD_COLOURS[index % len(METHOD_COLOURS)], label=name, lw=1.5)
        rows += [
            (name, f"{a:.4g}", f"{b:.4g}", int(n)) for a, b, n in zip(edges, edges[1:], counts, strict=False)
        ]
    left.set(xscale="log", yscale="log", xlabel="latency (µs)", ylabel="frames", ylim=(0.7, None))
    if len(np.unique(telemetry.method)) > 1:
        left.legend(frameon=False)
    course = _course(telemetry, latency, right)
    return _TEXT.figure("latency", figure, rows, course=course)


def _course(telemetry: Telemetry, latency: NDArray[np.float64], axes: Axes) -> str:
    """Draw the course of latencies in time; return what was drawn in words."""
    stretches = min(_MOST_TIMES, max(min(_FEW_TIMES, len(latency)), len(latency) // _FEWEST_TOGETHER))
    parts = np.array_split(np.arange(len(latency)), stretches)
    time = (telemetry.last_row_time_ns - telemetry.last_row_time_ns[0]) / 1e9
    middle = [float(time[part].mean()) for part in parts]
    style = {"marker": "o" if stretches <= _FEW_TIMES else "", "ms": 3}
    longest, medians = ([reduce(latency[part]) for part in parts] for reduce in (np.max, np.median))
    lines = [
        Line("longest", middle, longest, style={**style, "color": GREY, "lw": 1}),
        Line("median", middle, medians, style={**style, "color": "black", "lw": 1.3}),
    ]
    Panel(lines, "time since the first frame (s)", "latency (µs)", legend=True).draw(axes)
    axes.set_yscale("log")
    together = len(parts[0])
    return f"median and longest of stretches of {together} frames" if together > 1 else "every frame"


def methods_figure(telemetry: Telemetry, values: Mapping[str, Sequence[MethodDifference]]) -> FigureWithData:
    """Draw by how much every method differs from the first, a panel for each quantity."""
    panels, rows = [], []
    names = [method.method for method in next(iter(values.values()))]
    for name, compared in values.items():
        lines = []
        for row, method in enumerate(compared[1:]):
            shift = method.difference
            assert shift is not None
            spread = [[shift.value - shift.low], [shift.high - shift.value]]
            style = {"fmt": "o", "color": METHOD_COLOURS[(row + 1) % len(METHOD_COLOURS)], "capsize": 3}
            lines.append(Line("", [shift.value], [row], style=style, x_error=spread))
            rows.append((name, method.method, shift.value, shift.low, shift.high, shift.count))
        panels.append(Panel(lines, "", title=name, at={0.0: {}}, y_range=(len(names) - 1.4, -0.6)))
    figure = plot([panels], 1.6 + 0.45 * len(names), legend="")
    for panel in figure.axes:
        panel.set_yticks(
            range(len(names) - 1), names[1:] if panel is figure.axes[0] else [""] * (len(names) - 1)
        )
        panel.title.set_fontsize(10)
        panel.tick_params(axis="x", labelsize=9)
        panel.locator_params(axis="x", nbins=4)
    return _TEXT.figure("methods.figure", figure, rows, first=names[0])
