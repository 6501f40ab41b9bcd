"""The report page of telemetry that was recorded of a running engine."""

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, FigureWithData, Report, Section, configuration_section
from faintspot.base.report.plots import GREY, METHOD_COLOURS, Line, Panel
from faintspot.base.report.texts import Texts
from faintspot.engine.telemetry.numbers import (
    change_rows,
    compared_methods,
    gaps,
    method_names,
    quantities,
    restarts,
    timing,
)
from faintspot.io.telemetry import Telemetry, read_telemetry
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.page import SlopesRun, slopes_sections, warnings_in_words
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout

_TEXT = Texts("faintspot.slopes.recorded")
_MOST_CHANGES = 200
_PERCENTILES = (50.0, 99.0, 99.9, 100.0)
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
    methods = [
        MeasuredSlopes(name, _slopes(telemetry, rows), telemetry.frame[rows].astype(np.int64))
        for name, rows in _methods(telemetry)
    ]
    run = SlopesRun(methods, layout)
    return Report(
        title=f"Telemetry of {Path(path).name}",
        facts=_facts(telemetry, Path(path)),
        sections=[
            _timing(telemetry),
            *([_compared(telemetry)] if len(run.methods) > 1 else []),
            _changes(telemetry),
            *slopes_sections(run),
            configuration_section(str(telemetry.attributes.get("settings", ""))),
        ],
        warnings=[*_warnings(telemetry), *warnings_in_words(run)],
        remark=POSITIONS,
    )


def _methods(telemetry: Telemetry) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the name of each method, and which frames it measured."""
    for method, name in zip(np.unique(telemetry.method), method_names(telemetry), strict=True):
        yield name, telemetry.method == method


def _slopes(telemetry: Telemetry, rows: NDArray[np.bool_]) -> Slopes:
    names = {field.name for field in fields(Slopes) if not field.kw_only} - {"bad_pixels"}
    arrays = {name: getattr(telemetry, name)[rows] for name in names}
    return Slopes(**arrays, bad_pixels=np.zeros(arrays["x"].shape, np.int32))


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
    lost = int(gaps(telemetry).sum())
    return _TEXT.lines(
        "telemetry.warnings",
        lost=lost or None,
        share=100 * lost / (lost + len(telemetry.frame)),
        lost_changes=bool(telemetry.attributes.get("dropped_changes")),
    )


def _timing(telemetry: Telemetry) -> Section:
    (rate_hz, longest_s), lost = timing(telemetry), gaps(telemetry).tolist()
    rows = []
    for name, frames in _methods(telemetry):
        us = 1e6 * telemetry.latency_s[frames]
        rows.append([name, str(len(us)), *(f"{value:.1f}" for value in np.percentile(us, _PERCENTILES))])
    return _TEXT.section(
        "timing",
        _TEXT.table("timing", rows),
        latency_figure(telemetry),
        rate=rate_hz if np.isfinite(rate_hz) else None,
        longest_ms=1e3 * longest_s,
        lost=sum(lost) or None,
        gaps=len(lost),
        longest=max(lost, default=0),
        restarts=restarts(telemetry) or None,
        records=telemetry.attributes.get("dropped_records") or None,
        images=telemetry.attributes.get("dropped_images") or None,
    )


def _compared(telemetry: Telemetry) -> Section:
    names = method_names(telemetry)
    records = [
        {"quantity": quantity, **vars(each)}
        for quantity, values in quantities(telemetry).items()
        for each in compared_methods(telemetry.method, names, values)
    ]
    return _TEXT.section("methods", _TEXT.table("methods", records, first=records[0]["method"]))


def _changes(telemetry: Telemetry) -> Section:
    every = change_rows(telemetry)
    shown = [
        [str(frame), f"{seconds:.3f}" if np.isfinite(seconds) else "before", where, change]
        for frame, seconds, change, where in every[:_MOST_CHANGES]
    ]
    some = len(shown) if len(shown) < len(every) else None
    return _TEXT.section("changes", _TEXT.table("changes", shown, some=some, all=len(every)))


def latency_figure(telemetry: Telemetry) -> FigureWithData:
    """Draw how often each latency occurred, by method, and its course in time."""
    latency = 1e6 * telemetry.latency_s
    low, high = float(latency.min()), float(latency.max())
    edges = np.geomspace(max(low, 0.1), max(high, low + 1, 1.0) * 1.001, _BINS + 1)
    often = []
    for index, (name, frames) in enumerate(_methods(telemetry)):
        style = {"color": METHOD_COLOURS[index % len(METHOD_COLOURS)], "lw": 1.5, "drawstyle": "steps-post"}
        often.append(Line(name, edges[:-1], np.histogram(latency[frames], edges)[0], style=style))
    stretches = min(_MOST_TIMES, max(min(_FEW_TIMES, len(latency)), len(latency) // _FEWEST_TOGETHER))
    parts = np.array_split(np.arange(len(latency)), stretches)
    time = (telemetry.last_row_time_ns - telemetry.last_row_time_ns[0]) / 1e9
    middle = [float(time[part].mean()) for part in parts]
    course = [
        Line(
            name,
            middle,
            [reduce(latency[part]) for part in parts],
            style={"color": colour, "lw": 1.2, "marker": "o" if stretches <= _FEW_TIMES else "", "ms": 3},
        )
        for name, reduce, colour in (("longest", np.max, GREY), ("median", np.median, "black"))
    ]
    unit = "latency (µs)"
    left = Panel(often, unit, "frames", log="xy", y_range=(0.7, None), legend=len(often) > 1)
    right = Panel(course, "time since the first frame (s)", unit, log="y", legend=True)
    return _TEXT.figure("latency", [[left, right]], 4.6, {"together": len(parts[0])}, legend="")
