"""Page of a recorded loop: pictures and tables with errors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from faintspot.base.report.page import FigureWithData, Report, Table
from faintspot.base.report.plots import GREY, METHOD_COLOURS, WIDTH, Line, Panel, Picture
from faintspot.base.report.texts import Texts
from faintspot.loop.control.identification.open_loop import R0, Measured
from faintspot.loop.telemetry.over_time import Piece
from faintspot.loop.telemetry.report import LoopReport, Part

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
    more = {
        "noise": _noise_figure(report),
        "spectra": _spectra_figure(report),
        "choices": _choices_table(report),
    }
    for name, part in report.parts.items():
        sections.append(_TEXT.section(name, _table(part), more.get(name), missing=part.missing))
    loop = report.loop
    return Report(
        f"{'Loop' if loop.is_closed else 'Turbulence'} of {loop.name}",
        {"Sub-apertures": str(len(loop.cells)), "Frame rate": f"{loop.frame_rate_hz:.6g} Hz"},
        sections,
        [report.advice] if report.advice else [],
        warnings_title="What to do",
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


def _noise_figure(report: LoopReport) -> FigureWithData | None:
    """Draw the noise of each sub-aperture along x and y."""
    if report.noise_px is None or len(report.loop.cells) == 1:
        return None
    cells, halves = report.loop.cells - report.loop.cells.min(axis=0), report.noise_px.reshape(2, -1)
    limits, unit = {"vmin": np.nanmin(halves), "vmax": np.nanmax(halves)}, report.loop.slope_unit
    pictures = []
    for values, name in zip(halves, "xy", strict=True):
        grid = np.full(cells.max(axis=0) + 1, np.nan)
        grid[tuple(cells.T)] = values
        pictures.append(Picture(grid, f"noise ({unit})", f"noise of {name}", "column", "row", limits))
    return _TEXT.figure("noise", [pictures], 4.0, width=WIDTH * 0.7)


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
