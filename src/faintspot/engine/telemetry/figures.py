"""The pictures of a recorded night: latencies, and methods in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from faintspot.base.report.drawing import GREY, METHOD_COLOURS, WIDTH, new_figure, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.texts import Texts
from faintspot.engine.telemetry.numbers import MethodDifference, method_names
from faintspot.io.telemetry.recording import Telemetry

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
    stretches = min(_MOST_TIMES, max(min(_FEW_TIMES, len(latency)), len(latency) // _FEWEST_TOGETHER))
    marker = "o" if stretches <= _FEW_TIMES else ""
    parts = np.array_split(np.arange(len(latency)), stretches)
    time = (telemetry.last_row_time_ns - telemetry.last_row_time_ns[0]) / 1e9
    middle = [float(time[part].mean()) for part in parts]
    right.plot(
        middle, [latency[part].max() for part in parts], color=GREY, marker=marker, lw=1, label="longest"
    )
    medians = [np.median(latency[part]) for part in parts]
    right.plot(middle, medians, color="black", marker=marker, ms=3, lw=1.3, label="median")
    right.set(yscale="log", xlabel="time since the first frame (s)", ylabel="latency (µs)")
    right.legend(frameon=False)
    n_together = len(parts[0])
    course = f"median and longest of stretches of {n_together} frames" if n_together > 1 else "every frame"
    return _TEXT.figure("latency", figure, rows, course=course)


@styled
def methods_figure(telemetry: Telemetry, values: Mapping[str, Sequence[MethodDifference]]) -> FigureWithData:
    """Draw by how much every method differs from the first, a panel for each quantity."""
    figure = new_figure(WIDTH, 1.6 + 0.45 * len(method_names(telemetry)))
    rows = []
    for panel, (name, compared) in zip(figure.subplots(1, len(values)), values.items(), strict=True):
        methods = [method for method in compared if method.difference is not None]
        for row, method in enumerate(methods):
            shift = method.difference
            assert shift is not None
            spread = np.nan_to_num([[shift.value - shift.low], [shift.high - shift.value]])
            colour = METHOD_COLOURS[(row + 1) % len(METHOD_COLOURS)]
            panel.errorbar([shift.value], [row], xerr=spread, fmt="o", color=colour, capsize=3)
            rows.append((name, method.method, shift.value, shift.low, shift.high, shift.count))
        panel.axvline(0, color=GREY, lw=1)
        panel.set_yticks(
            range(len(methods)),
            [method.method for method in methods] if not panel.get_subplotspec().colspan.start else [],
        )
        panel.set_ylim(len(methods) - 0.4, -0.6)
        panel.set_title(name, fontsize=10)
        panel.tick_params(axis="x", labelsize=9)
        panel.locator_params(axis="x", nbins=4)
    first = next(iter(values.values()))[0].method
    return _TEXT.figure("methods.figure", figure, rows, first=first)
