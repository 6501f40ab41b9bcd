"""The report page of telemetry that was recorded of a running engine."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.flags import leave_out
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import POSITIONS, Report, Section, configuration_section
from faintspot.base.report.plots import GREY, METHOD_COLOURS, WIDTH, Line, Panel, new_figure, styled
from faintspot.base.report.texts import Texts
from faintspot.engine.telemetry.numbers import (
    PERCENTILES,
    change_rows,
    gaps,
    method_names,
    methods_in_turn,
    quantities,
    restarts,
    timing,
)
from faintspot.io.telemetry.recording import Telemetry, read_telemetry
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.report.page import slopes_sections, warnings_in_words
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.statistics import ARRAYS, MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TEXT = Texts("faintspot.slopes.recorded")
_MOST_CHANGES = 200
_BINS = 80
# Points of the course in time, frames in each, and so many points that they are drawn as dots.
_MOST_TIMES, _FEWEST_TOGETHER, _FEW_TIMES = 400, 50, 20


def report_of_telemetry(path: str | Path) -> Report:
    """Return the report of a store that `faintspot realtime record` has written.

    Raises
    ------
    InputError
        When it is no such store, damaged, or without frames.
    MissingExtraError
        When matplotlib or zarr is not installed.
    """
    telemetry = read_telemetry(path, images=False)
    if len(telemetry.frame) == 0:
        raise InputError(f"{path}: expected telemetry, no frame is recorded yet")
    layout = Layout(**telemetry.attributes["layout"])
    run = SlopesRun(_measured(telemetry), layout, why_no_stages="", slopes=_slopes(telemetry))
    return Report(
        title=f"Telemetry of {Path(path).name}",
        facts=_facts(telemetry, Path(path)),
        sections=[
            _timing(telemetry),
            _lost(telemetry),
            *([_methods(telemetry)] if len(run.methods) > 1 else []),
            _changes(telemetry),
            *slopes_sections(run),
            configuration_section(str(telemetry.attributes.get("settings", ""))),
        ],
        warnings=[*_warnings(telemetry), *run.comparison.warnings(), *warnings_in_words(run)],
        remark=POSITIONS,
    )


def _measured(telemetry: Telemetry) -> list[MeasuredSlopes]:
    """Return the slopes of every method, each with the frames that it measured."""
    errors = np.hypot(telemetry.standard_error_x, telemetry.standard_error_y) / np.sqrt(2)
    measured = []
    for method, name in zip(np.unique(telemetry.method), method_names(telemetry), strict=True):
        rows = telemetry.method == method
        arrays = [getattr(telemetry, array)[rows] for array in ARRAYS]
        finite = errors[rows][telemetry.valid[rows] & np.isfinite(errors[rows])]
        stated = float(np.median(finite)) if finite.size else np.nan
        frames = telemetry.frame[rows].astype(np.int64)
        measured.append(MeasuredSlopes(name, *arrays, frames=frames, standard_error_px=stated))
    return measured


def _facts(telemetry: Telemetry, path: Path) -> dict[str, str]:
    names = method_names(telemetry)
    return _TEXT.facts(
        "telemetry.facts",
        path=path,
        name=telemetry.attributes.get("name", "not stored"),
        begun=np.datetime64(round(telemetry.unix_time_s[0] * 1e3), "ms"),
        frames=len(telemetry.frame),
        seconds=float(telemetry.last_row_time_ns[-1] - telemetry.last_row_time_ns[0]) / 1e9,
        subapertures=telemetry.x.shape[1],
        ended=telemetry.attributes.get("ended_because", "not known; it may still go on"),
        in_turn=", ".join(names) if len(names) > 1 else None,
    )


def _warnings(telemetry: Telemetry) -> list[str]:
    lost = sum(gap.lost for gap in gaps(telemetry))
    _, left_out = leave_out(telemetry.flags)
    return _TEXT.lines(
        "telemetry.warnings",
        lost=lost or None,
        share=100 * lost / (lost + len(telemetry.frame)),
        lost_changes=bool(telemetry.attributes.get("dropped_changes")),
        left_out=left_out.capitalize() or None,
    )


def _timing(telemetry: Telemetry) -> Section:
    measured = timing(telemetry)
    rows = []
    for method, name in zip(np.unique(telemetry.method), method_names(telemetry), strict=True):
        us = 1e6 * telemetry.latency_s[telemetry.method == method]
        rows.append([name, str(len(us)), *(f"{value:.1f}" for value in np.percentile(us, PERCENTILES))])
    return _TEXT.section(
        "timing",
        _TEXT.table("timing", rows),
        latency_figure(telemetry),
        rate=measured.rate_hz if np.isfinite(measured.rate_hz) else None,
        longest_ms=1e3 * measured.longest_interval_s,
    )


def _lost(telemetry: Telemetry) -> Section:
    every = gaps(telemetry)
    numbers = _TEXT.facts(
        "lost.numbers",
        lost=sum(gap.lost for gap in every),
        gaps=len(every),
        longest=max((gap.lost for gap in every), default=0),
        restarts=restarts(telemetry),
        **{name: telemetry.attributes.get(f"dropped_{name}", 0) for name in ("records", "images", "changes")},
    )
    return _TEXT.section("lost", _TEXT.table("lost.table", list(numbers.items())))


def _methods(telemetry: Telemetry) -> Section:
    differences = {name: methods_in_turn(telemetry, values) for name, values in quantities(telemetry).items()}
    records = []
    for name, compared in differences.items():
        for each in compared:
            too_few = each.difference is not None and not math.isfinite(each.difference.low)
            difference = None if too_few else each.difference
            records.append({"quantity": name, **vars(each), "difference": difference, "too_few": too_few})
    first = next(iter(differences.values()))[0].method
    return _TEXT.section("methods", _TEXT.table("methods", records, first=first))


def _changes(telemetry: Telemetry) -> Section:
    every = change_rows(telemetry)
    shown = [
        [str(frame), f"{seconds:.3f}" if np.isfinite(seconds) else "before", where, change]
        for frame, seconds, change, where in every[:_MOST_CHANGES]
    ]
    some = len(shown) if len(shown) < len(every) else None
    return _TEXT.section("changes", _TEXT.table("changes", shown, some=some, all=len(every)))


def _slopes(telemetry: Telemetry) -> dict[str, Slopes]:
    """Return the slopes of every method."""
    errors = "standard_error_x", "standard_error_y", "covariance_xy"
    names = ("x", "y", "flux", "flags", "iterations", *errors)
    slopes = {}
    for method, name in zip(np.unique(telemetry.method), method_names(telemetry), strict=True):
        arrays = {array: getattr(telemetry, array)[telemetry.method == method] for array in names}
        slopes[name] = Slopes(**arrays, bad_pixels=np.zeros(arrays["x"].shape, np.int32))
    return slopes


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
