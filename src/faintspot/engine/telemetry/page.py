"""The report page of telemetry that was recorded of a running engine."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, Page, Section, Table, configuration_section, html_of
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
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
from faintspot.slopes.recorded.report.sections import all_sections, make_run
from faintspot.slopes.recorded.report.sodium_section import sodium_sections_of_changes
from faintspot.slopes.recorded.report.wavefront_section import wavefront_sections
from faintspot.slopes.recorded.statistics import ARRAYS, MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout

_TEXT = Texts("faintspot.slopes.recorded")
_MOST_GAPS, _MOST_CHANGES = 20, 200


def report_of_telemetry(path: str | Path) -> str:
    """Return the report page (HTML) of a store that `faintspot realtime record` has written.

    Raises
    ------
    InputError
        When it is no such store, damaged, or without frames.
    MissingExtraError
        When matplotlib, jinja2 or zarr is not installed.
    """
    telemetry = read_telemetry(path, images=False)
    if len(telemetry.frame) == 0:
        raise InputError(f"{path}: expected telemetry, no frame is recorded yet")
    layout = Layout(**telemetry.attributes["layout"])
    run = make_run(_measured(telemetry), layout, {}, None, 0, "", ())
    sections = [_timing(telemetry), _lost(telemetry)]
    if len(method_names(telemetry)) > 1:
        sections.append(_methods(telemetry))
    sections += [_changes(telemetry), *sodium_sections_of_changes(telemetry.changes)]
    sections += [*all_sections(run), *wavefront_sections(_slopes(telemetry), layout)]
    settings = str(telemetry.attributes.get("settings", ""))
    return html_of(
        Page(
            title=f"Telemetry of {Path(path).name}",
            facts=_facts(telemetry, Path(path)),
            sections=[*sections, configuration_section(settings)],
            warnings=[
                *_warnings(telemetry),
                *run.comparison.warnings(),
                *warnings_in_words(run.methods, run.summaries),
            ],
            remark=POSITIONS,
        )
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
    seconds = float(telemetry.last_row_time_ns[-1] - telemetry.last_row_time_ns[0]) / 1e9
    begun = np.datetime64(round(telemetry.unix_time_s[0] * 1e3), "ms")
    ended = telemetry.attributes.get("ended_because", "not known; it may still go on")
    facts = {
        "Store": str(path),
        "Engine": str(telemetry.attributes.get("name", "not stored")),
        "Begun": f"{begun} UTC, by the wall clock",
        "Frames": f"{len(telemetry.frame)} in {seconds:.1f} s",
        "Sub-apertures": str(telemetry.x.shape[1]),
        "Ended": str(ended),
    }
    names = method_names(telemetry)
    return facts | ({"In turn": ", ".join(names)} if len(names) > 1 else {})


def _warnings(telemetry: Telemetry) -> list[str]:
    lines = []
    lost = sum(gap.lost for gap in gaps(telemetry))
    if lost:
        share = 100 * lost / (lost + len(telemetry.frame))
        lines.append(_TEXT("telemetry.lost_frames", lost=lost, share=share))
    if telemetry.attributes.get("dropped_changes"):
        lines.append(_TEXT["telemetry.lost_changes"])
    _, left_out = leave_out(telemetry.flags)
    return [*lines, f"{left_out.capitalize()}."] if left_out else lines


def _timing(telemetry: Telemetry) -> Section:
    measured = timing(telemetry)
    latency = 1e6 * telemetry.latency_s
    rows = []
    for method, name in zip(np.unique(telemetry.method), method_names(telemetry), strict=True):
        us = latency[telemetry.method == method]
        rows.append([name, str(len(us)), *(f"{value:.1f}" for value in np.percentile(us, PERCENTILES))])
    header = ["", "frames", "median (µs)", "99 % (µs)", "99.9 % (µs)", "longest (µs)"]
    table = Table(header, rows, caption="Latency: from a frame's last row to its slopes.")
    rate = "not known: no two frames have consecutive numbers"
    if np.isfinite(measured.rate_hz):
        rate = _TEXT("telemetry.rate", rate=measured.rate_hz, longest=1e3 * measured.longest_interval_s)
    return Section("timing", "Rate and latency", [f"Rate: {rate}."], [table], [latency_figure(telemetry)])


def _lost(telemetry: Telemetry) -> Section:
    gap_list = gaps(telemetry)
    lost = sum(gap.lost for gap in gap_list)
    dropped = {
        name: telemetry.attributes.get(f"dropped_{name}", 0) for name in ("records", "images", "changes")
    }
    rows = [
        ["frame numbers that are missing", str(lost)],
        ["of them overwritten before the recorder read them", str(dropped["records"])],
        ["gaps", str(len(gap_list))],
        ["longest gap, frames", str(max((gap.lost for gap in gap_list), default=0))],
        ["times that frame numbers began anew", str(restarts(telemetry))],
        ["images lost to the record", str(dropped["images"])],
        ["changes of settings lost to the record", str(dropped["changes"])],
    ]
    text = [_TEXT["telemetry.lost"]]
    tables = [Table(["", "number"], rows)]
    if gap_list:
        listed = [[str(gap.after_frame), str(gap.lost)] for gap in gap_list[:_MOST_GAPS]]
        caption = f"The first {len(listed)} of {len(gap_list)} gaps."
        tables.append(Table(["after frame", "frames lost"], listed, caption, folded="Where"))
    return Section("lost", "Lost frames", text, tables)


def _methods(telemetry: Telemetry) -> Section:
    rows = []
    differences = {name: methods_in_turn(telemetry, values) for name, values in quantities(telemetry).items()}
    for name, compared in differences.items():
        for method in compared:
            difference = "–" if method.difference is None else _in_words(method.difference)
            rows.append([name, method.method, _with_error(method.mean), difference])
    first = next(iter(differences.values()))[0].method
    header = ["", "method", "mean ± standard error", f"less {first!r} (95 %)"]
    text = [_TEXT["methods.text"]]
    return Section(
        "methods", "Methods in turn", text, [Table(header, rows)], [methods_figure(telemetry, differences)]
    )


def _in_words(estimate: Estimate) -> str:
    if not np.isfinite(estimate.low):
        return "too few turns"
    value, low, high = (
        f"{number:+.3g}".replace("-", "−") for number in (estimate.value, estimate.low, estimate.high)
    )
    return f"{value} ({low} to {high})"


def _with_error(estimate: Estimate) -> str:
    error = f"{estimate.standard_error:.2g}" if np.isfinite(estimate.standard_error) else "?"
    return f"{estimate.value:.4g} ± {error}"


def _changes(telemetry: Telemetry) -> Section:
    title = "Changes of settings"
    change_list = change_rows(telemetry)
    if not change_list:
        return Section("changes", title, ["None: the settings are those at the end of this page."])
    rows = [
        [str(frame), f"{seconds:.3f}" if np.isfinite(seconds) else "before", where, change]
        for frame, seconds, change, where in change_list[:_MOST_CHANGES]
    ]
    caption = f"The first {len(rows)} of {len(change_list)} changes." if len(rows) < len(change_list) else ""
    table = Table(["from frame", "at (s)", "sub-apertures", "change"], rows, caption, words=True)
    return Section("changes", title, tables=[table])


def _slopes(telemetry: Telemetry) -> dict[str, Slopes]:
    """Return the slopes of every method."""
    errors = "standard_error_x", "standard_error_y", "covariance_xy"
    names = ("x", "y", "flux", "flags", "iterations", *errors)
    slopes = {}
    for method, name in zip(np.unique(telemetry.method), method_names(telemetry), strict=True):
        arrays = {array: getattr(telemetry, array)[telemetry.method == method] for array in names}
        slopes[name] = Slopes(**arrays, bad_pixels=np.zeros(arrays["x"].shape, np.int32))
    return slopes
