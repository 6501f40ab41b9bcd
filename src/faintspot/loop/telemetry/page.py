"""Page of a recorded loop: pictures and tables with errors."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.files import csv_text
from faintspot.base.report.page import FigureWithData, Report, Table
from faintspot.base.report.plots import GREY, METHOD_COLOURS, WIDTH, Line, Panel, Picture, draw
from faintspot.base.report.texts import Texts
from faintspot.loop.control.identification.open_loop import FEWEST_FRAMES, R0, Measured
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.telemetry.report import LoopReport, Part, noise_of_loop, report_of_loop

_PARTS = ("noise", "turbulence")
_OF_ONE = "layer "
"""Start of names that not every piece has."""


@dataclass(frozen=True)
class Piece:
    """Piece of a recording."""

    start_s: float
    """From the first frame of the recording."""
    duration_s: float
    values: dict[str, Measured]
    """By name; layers are left out, as their number changes."""
    missing: str = ""
    """Reason for missing values."""


def turbulence_over_time(
    loop: Recording, every_s: float, progress: Callable[[int, int], None] = lambda *_: None
) -> list[Piece]:
    """Return noise and turbulence of each piece of a recording.

    Parameters
    ----------
    loop : Recording
    every_s : float
        Length of a piece; a shorter rest at the end is left out.
    progress : callable
        Called with the number of finished pieces and of all.

    Raises
    ------
    InputError
        When a piece is too short, or the recording shorter than one.
    """
    fewest_s = 2 * FEWEST_FRAMES / loop.frame_rate_hz
    # 1.1 s of 400 frames each are 440 frames, without the error of rounding.
    length = round(number_between("every_s", every_s, fewest_s) * loop.frame_rate_hz, 6)
    since = loop.frame - loop.frame[0]
    count = int((since[-1] + 1) / length)
    if count < 1:
        duration = (since[-1] + 1) / loop.frame_rate_hz
        raise InputError(f"every_s = {every_s:g}: expected at most the recording's {duration:g} s")
    pieces = []
    for number in range(count):
        rows = slice(*np.searchsorted(since, [number * length, (number + 1) * length]))
        pieces.append(_piece(loop, rows, number * every_s, every_s))
        progress(number + 1, count)
    return pieces


def table_of_pieces(pieces: Sequence[Piece]) -> str:
    """Return a CSV table: a row for each piece, with value and standard error of each quantity."""
    names = {name: value.unit for piece in pieces for name, value in piece.values.items()}
    header = [f"{name} ({unit})" if unit else name for name, unit in names.items()]
    rows = []
    for piece in pieces:
        known = [piece.values.get(name, Measured(name, "")) for name in names]
        numbers = [number for value in known for number in (value.value, value.error)]
        shown = [f"{number:.6g}" if math.isfinite(number) else "" for number in numbers]
        rows.append([f"{piece.start_s:g}", f"{piece.duration_s:g}", *shown])
    columns = (f"{kind}{text}" for text in header for kind in ("", "error of "))
    return csv_text(["start_s", "duration_s", *columns], rows)


def _piece(loop: Recording, rows: slice, start_s: float, duration_s: float) -> Piece:
    if rows.stop - rows.start < FEWEST_FRAMES:
        return Piece(start_s, duration_s, {}, f"{rows.stop - rows.start} frames, expected {FEWEST_FRAMES}")
    try:
        report = report_of_loop(loop.part(rows), compare=False)
    except InputError as error:
        return Piece(start_s, duration_s, {}, str(error))
    parts = [report.parts[name] for name in _PARTS]
    values = [value for part in parts for value in part.values if not value.name.startswith(_OF_ONE)]
    missing = " ".join(part.missing for part in parts if part.missing)
    return Piece(start_s, duration_s, {value.name: value for value in values}, missing)


_TEXT = Texts("faintspot.loop.telemetry")
_AGAINST_TIME = (
    R0,
    "r0 at 500 nm from differential image motion",
    "coherence time at 500 nm",
    "wind speed, mean for the coherence time",
    "noise of a slope",
)
"""Quantities of pieces that are drawn."""
_MOST_DECIMALS = 6
_MEASURED = {"fmt": "o-", "color": METHOD_COLOURS[1], "capsize": 3}


def page_of_loop(report: LoopReport, pieces: Sequence[Piece] = ()) -> Report:
    """Return the page of a report, and of pieces of its recording."""
    sections = []
    if pieces:
        missing = "; ".join(f"{piece.start_s:g} s: {piece.missing}" for piece in pieces if piece.missing)
        sections.append(_TEXT.section("time", _time_figure(pieces), missing=missing))
    loop = report.loop
    more: dict[str, Sequence[str] | Table | FigureWithData | None] = {
        "frames": loop.remarks,
        "noise": _noise_figure(report),
        "scintillation": _scintillation_figure(report),
        "spectra": _spectra_figure(report),
        "choices": _choices_table(report),
    }
    for name, part in report.parts.items():
        if name == "loop" and not part.values:  # of an open loop
            continue
        sections.append(_TEXT.section(name, _table(part), more.get(name), missing=part.missing))
    without_cells = loop.cells is None
    size = {"Slopes": loop.slopes.shape[1]} if without_cells else {"Sub-apertures": len(loop.cells)}
    return Report(
        f"{'Loop' if loop.is_closed else 'Turbulence'} of {loop.name}",
        {**{name: f"{n}" for name, n in size.items()}, "Frame rate": f"{loop.frame_rate_hz:.6g} Hz"},
        sections,
        report.doubts or list(filter(None, [report.advice])),
        warnings_title=_TEXT["doubts.title" if report.doubts else "advice"],
        remark=_TEXT["remark"],
    )


def _table(part: Part) -> Table:
    shown = [
        {**vars(value), "shown": _with_interval(value, value.unit) or "not known"} for value in part.values
    ]
    return _TEXT.table("values", shown)


def _choices_table(report: LoopReport) -> Table:
    compared = ("residual", "less", "strehl")
    records = [
        {
            **vars(choice),
            "text": choice.gain_text or None,
            **{name: _with_interval(getattr(choice, name)) for name in compared},
        }
        for choice in report.choices
    ]
    return _TEXT.table("choices", records, unit=report.choices[0].residual.unit if records else "")


def _with_interval(measured: Measured, unit: str = "") -> str | None:
    """Return a value with its 95 % interval, None if it is not known; counts have no interval."""
    if not np.isfinite(measured.value) or not np.isfinite(measured.error):
        return None
    if measured.error == 0:
        return f"{measured.value:.6g} {unit}".rstrip()
    decimals = max(0, 1 - int(np.floor(np.log10(measured.error))))
    style = f".{decimals}f" if decimals <= _MOST_DECIMALS else ".1e"
    value, low_text, high_text = (f"{number:{style}}" for number in (measured.value, *measured.interval))
    text = f"{value} {unit}".rstrip() + f" ({low_text} to {high_text})"
    return text.replace("-", "−")


def _time_figure(pieces: Sequence[Piece]) -> FigureWithData:
    """Draw r0, coherence time, wind and noise of each piece."""
    middle = [piece.start_s + piece.duration_s / 2 for piece in pieces]
    panels = []
    for name in _AGAINST_TIME:
        values = [piece.values.get(name, Measured(name, "")) for piece in pieces]
        unit = next((value.unit for value in values if math.isfinite(value.value)), None)
        if unit is not None:
            numbers = np.array([(value.value, *value.interval) for value in values]).T
            line = Line(name, middle, numbers[0], np.abs(numbers[1:] - numbers[0]), _MEASURED)
            panels.append([Panel([line], "time since the first frame (s)", unit, name, y_range=(0, None))])
    panels = panels or [[Panel([], "")]]
    return _TEXT.figure("time", panels, 2.6 * len(panels), legend="", shared=True)


def plot_recording(loop: Recording, axes: Any) -> Any:
    """Draw what `Recording.plot` returns."""
    report = noise_of_loop(loop)
    pictures = _noise_pictures(report)
    if not pictures:
        raise InputError(report.parts["noise"].missing or "cells: expected several sub-apertures, got none")
    return draw([pictures], axes)


def _noise_figure(report: LoopReport) -> FigureWithData | None:
    """Draw the noise of each sub-aperture along x and y."""
    pictures = _noise_pictures(report)
    return _TEXT.figure("noise", [pictures], 4.0, width=WIDTH * 0.7) if pictures else None


def _noise_pictures(report: LoopReport) -> list[Picture]:
    if report.noise_px is None or report.loop.cells is None or len(report.loop.cells) == 1:
        return []
    halves, unit = report.noise_px.reshape(2, -1), report.loop.slope_unit
    limits = {"vmin": np.nanmin(halves), "vmax": np.nanmax(halves)}
    return [
        _map(report, values, f"noise ({unit})", f"noise of {name}", limits)
        for values, name in zip(halves, "xy", strict=True)
    ]


def _scintillation_figure(report: LoopReport) -> FigureWithData | None:
    """Draw the scintillation index of each sub-aperture."""
    found = report.scintillation
    if found is None or not (found.index > 2 * found.index_error).any():
        return None
    picture = _map(report, found.index, "index", "scintillation index", {"vmin": 0.0})
    return _TEXT.figure("scintillation", [[picture]], 4.0, width=WIDTH * 0.4)


def _map(report: LoopReport, values: Floats, unit: str, title: str, limits: dict[str, Any]) -> Picture:
    """Return a picture of values of each sub-aperture."""
    cells = report.loop.cells - report.loop.cells.min(axis=0)
    grid = np.full(cells.max(axis=0) + 1, np.nan)
    grid[tuple(cells.T)] = values
    return Picture(grid, unit, title, "column", "row", limits)


def _spectra_figure(report: LoopReport) -> FigureWithData | None:
    """Draw spectra of open-loop slopes and of the fitted model."""
    spectra = report.spectra
    if spectra is None:
        return None
    factor = np.exp(1.96 / np.sqrt(0.55 * spectra.pieces))
    panels: list[Panel] = []
    for name in spectra.measured:
        measured, model = (report.loop.unit**2 * power[name] for power in (spectra.measured, spectra.model))
        scatter, style = (model - model / factor, model * factor - model), {"color": METHOD_COLOURS[0]}
        lines = [
            Line("measured", spectra.frequency_hz, measured, style={"color": GREY, "lw": 1}),
            Line("fitted", spectra.frequency_hz, model, scatter, {**style, "lw": 1.6}, band=True),
        ]
        unit = f"slope² ({report.loop.slope_unit}²/Hz)"
        panels.append(Panel(lines, "frequency (Hz)", unit, name, log="xy", legend=True))
    pairs = [panels[first : first + 2] for first in range(0, len(panels), 2)]
    return _TEXT.figure("spectra", pairs, 3.6 * len(pairs), legend="")
