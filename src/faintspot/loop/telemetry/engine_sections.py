"""Sections of a page that only the recordings of the engine have: latencies, changes of settings, slopes."""

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.report.page import FigureWithData, Report, Section, Table, configuration_section
from faintspot.base.report.plots import GREY, METHOD_COLOURS, Line, Panel
from faintspot.base.report.texts import Texts
from faintspot.io.telemetry import Telemetry, read_telemetry
from faintspot.loop.telemetry.turns import compared_methods
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.recorded.page import SlopesRun, slopes_sections, warnings_in_words
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout

_TEXT = Texts("faintspot.loop.telemetry")
_MOST_CHANGES = 200
_LONGEST = 80  # text of a changed value
_PERCENTILES = (50.0, 99.0, 99.9, 100.0)
_BINS = 80
# Points of the course in time, frames in each, and so many points that they are drawn as dots.
_MOST_TIMES, _FEWEST_TOGETHER, _FEW_TIMES = 400, 50, 20


def with_engine(page: Report, path: str | Path) -> Report:
    """Return the page of a recording of the engine with the sections that need the engine's own data.

    Raises
    ------
    InputError
        When the store cannot be read.
    """
    telemetry = read_telemetry(path, images=False)
    methods = [
        MeasuredSlopes(name, _slopes(telemetry, rows), telemetry.frame[rows].astype(np.int64))
        for name, rows in _methods(telemetry)
    ]
    run = SlopesRun(methods, Layout(**telemetry.attributes["layout"]))
    settings = configuration_section(str(telemetry.attributes.get("settings", "")))
    return replace(page, sections=[*page.sections, _engine(telemetry, run), *slopes_sections(run), settings])


def _methods(telemetry: Telemetry) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the name of each method that has frames, and which frames it measured."""
    names = telemetry.attributes.get("methods") or ["slopes"]
    for method in np.unique(telemetry.method):
        yield names[method] if method < len(names) else f"method {method}", telemetry.method == method


def _slopes(telemetry: Telemetry, rows: NDArray[np.bool_]) -> Slopes:
    names = {field.name for field in fields(Slopes) if not field.kw_only} - {"bad_pixels"}
    arrays = {name: getattr(telemetry, name)[rows] for name in names}
    return Slopes(**arrays, bad_pixels=np.zeros(arrays["x"].shape, np.int32))


def _engine(telemetry: Telemetry, run: SlopesRun) -> Section:
    rows = []
    for name, frames in _methods(telemetry):
        us = 1e6 * telemetry.latency_s[frames]
        rows.append([name, str(len(us)), *(f"{value:.1f}" for value in np.percentile(us, _PERCENTILES))])
    attributes = telemetry.attributes
    return _TEXT.section(
        "engine",
        warnings_in_words(run),
        _TEXT.table("timing", rows),
        latency_figure(telemetry),
        _compared(telemetry) if len(run.methods) > 1 else None,
        _changes(telemetry),
        name=attributes.get("name", "not stored"),
        begun=np.datetime64(round(telemetry.unix_time_s[0] * 1e3), "ms"),
        ended=attributes.get("ended_because", "not known; it may still go on"),
        records=attributes.get("dropped_records") or None,
        images=attributes.get("dropped_images") or None,
        lost_changes=bool(attributes.get("dropped_changes")),
    )


def quantities(telemetry: Telemetry) -> dict[str, Floats]:
    """Return what methods are compared in, by its name with unit, a number for each frame; NaN where none is.

    The rms of slopes is taken about each sub-aperture's mean in the method, which differs between methods.
    """
    valid = telemetry.valid
    count = valid.sum(axis=1)
    squares = np.zeros(len(valid))
    for method in np.unique(telemetry.method):
        rows = telemetry.method == method
        used = valid[rows]
        for axis in (telemetry.x, telemetry.y):
            values = np.where(used, axis[rows], 0.0).astype(np.float64)
            mean = values.sum(axis=0) / np.maximum(used.sum(axis=0), 1)
            squares[rows] += np.sum(np.where(used, values - mean, 0.0) ** 2, axis=1)
    n_valid = np.where(count > 0, count, np.nan)
    flux = np.where(valid, telemetry.flux, 0.0).sum(axis=1) / n_valid
    return {
        "rms of slopes about their mean (px)": np.sqrt(squares / (2 * n_valid)),
        "flux (e-)": flux,
        "valid (%)": 100.0 * valid.mean(axis=1),
        "latency (µs)": 1e6 * telemetry.latency_s,
    }


def _compared(telemetry: Telemetry) -> Table:
    names = [name for name, _ in _methods(telemetry)]
    records = [
        {"quantity": quantity, **vars(compared)}
        for quantity, values in quantities(telemetry).items()
        for compared in compared_methods(telemetry.method, names, values)
    ]
    return _TEXT.table("methods", records, first=names[0])


def _changes(telemetry: Telemetry) -> Table:
    shown, start = [], telemetry.last_row_time_ns[0]
    for change in telemetry.changes[:_MOST_CHANGES]:
        index = int(np.searchsorted(telemetry.frame, change["frame"]))
        inside = index < len(telemetry.frame) and change["frame"] >= telemetry.frame[0]
        time = f"{(telemetry.last_row_time_ns[index] - start) / 1e9:.3f}" if inside else "before"
        text = ", ".join(f"{name} = {_shortened(value)}" for name, value in change["changes"].items())
        where = change["where"]
        if not isinstance(where, str):
            where = "all" if where is None else ", ".join(map(str, where))
        shown.append([str(change["frame"]), time, where, text])
    some = len(shown) if len(shown) < len(telemetry.changes) else None
    return _TEXT.table("changes", shown, some=some, all=len(telemetry.changes))


def _shortened(value: object) -> str:
    """Return a value as text of limited length."""
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


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
