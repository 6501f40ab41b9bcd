"""The report page of telemetry that was recorded of a running engine."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, Report, Section, configuration_section
from faintspot.base.report.texts import Texts
from faintspot.base.validity import leave_out
from faintspot.engine.telemetry.figures import latency_figure, methods_figure
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
from faintspot.slopes.recorded.report.advice import warnings_in_words
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.report.sections import slopes_sections
from faintspot.slopes.recorded.report.sodium_section import sodium_sections_of_changes
from faintspot.slopes.recorded.statistics import ARRAYS, MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout

_TEXT = Texts("faintspot.slopes.recorded")
_MOST_GAPS, _MOST_CHANGES = 20, 200


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
            *sodium_sections_of_changes(telemetry.changes),
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
    is_known = bool(np.isfinite(measured.rate_hz))
    return _TEXT.section(
        "timing",
        _TEXT.table("timing", rows),
        latency_figure(telemetry),
        rate=measured.rate_hz if is_known else None,
        unknown=not is_known,
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
    shown = every[:_MOST_GAPS]
    return _TEXT.section(
        "lost",
        _TEXT.table("lost.table", list(numbers.items())),
        _TEXT.table("lost.gaps", shown, shown=len(shown), all=len(every)),
    )


def _methods(telemetry: Telemetry) -> Section:
    differences = {name: methods_in_turn(telemetry, values) for name, values in quantities(telemetry).items()}
    records = []
    for name, compared in differences.items():
        for each in compared:
            too_few = each.difference is not None and not math.isfinite(each.difference.low)
            difference = None if too_few else each.difference
            records.append({"quantity": name, **vars(each), "difference": difference, "too_few": too_few})
    first = next(iter(differences.values()))[0].method
    return _TEXT.section(
        "methods", _TEXT.table("methods", records, first=first), methods_figure(telemetry, differences)
    )


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
