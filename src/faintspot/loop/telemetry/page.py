"""Page of a recorded loop: pictures and tables with errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import Report, Table
from faintspot.base.report.plots import (
    GREY,
    METHOD_COLOURS,
    WIDTH,
    Line,
    Panel,
    colour_bar,
    new_figure,
    plot,
    styled,
)
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
    figures: dict[str, Callable[[LoopReport], FigureWithData | None]] = {
        "noise": _noise_figure,
        "spectra": _spectra_figure,
    }
    sections = []
    if pieces:
        missing = "; ".join(f"{piece.start_s:g} s: {piece.missing}" for piece in pieces if piece.missing)
        sections.append(_TEXT.section("time", _time_figure(pieces), missing=missing))
    for name, part in report.parts.items():
        figure = figures[name](report) if name in figures else None
        replayed = _choices_table(report) if name == "choices" else None
        sections.append(_TEXT.section(name, _table(part), replayed, figure, missing=part.missing))
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
    compared = ("residual", "less", "total", "strehl")
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
    middle = np.array([piece.start_s + piece.duration_s / 2 for piece in pieces])
    panels: list[list[Panel]] = []
    rows: list[tuple[object, ...]] = []
    for name in _AGAINST_TIME:
        values = [piece.values.get(name, Measured(name, "")) for piece in pieces]
        known = [value for value in values if math.isfinite(value.value)]
        if known:
            numbers = np.array([(value.value, *value.interval) for value in values]).T
            line = Line("", middle, numbers[0], np.abs(numbers[1:] - numbers[0]), _MEASURED)
            panels.append([Panel([line], "", known[0].unit, name, y_range=(0, None))])
            rows += [(name, time, *number) for time, number in zip(middle, numbers.T, strict=True)]
    panels = panels or [[Panel([], "")]]
    panels[-1] = [replace(panels[-1][0], x="time since the first frame (s)")]
    figure = plot(panels, 2.4 * len(panels), legend="", sharex=True)
    return _TEXT.figure("time", figure, rows, ("quantity", "time", "value", "low", "high"))


@styled
def _noise_figure(report: LoopReport) -> FigureWithData | None:
    """Draw the noise of each sub-aperture along x and y."""
    if report.noise_px is None or len(report.loop.cells) == 1:
        return None
    figure, cells = new_figure(WIDTH * 0.7, 4.0), report.loop.cells - report.loop.cells.min(axis=0)
    axes = list(figure.subplots(1, 2))
    halves = report.noise_px.reshape(2, -1)
    for panel, values, name in zip(axes, halves, "xy", strict=True):
        grid = np.full(cells.max(axis=0) + 1, np.nan)
        grid[tuple(cells.T)] = values
        shown = panel.imshow(grid, vmin=np.nanmin(halves), vmax=np.nanmax(halves))
        panel.set(title=f"noise of {name}", xlabel="column", ylabel="row")
    colour_bar(axes, shown, report.loop.slope_unit)
    rows = [(*cell, *pair) for cell, pair in zip(report.loop.cells, halves.T, strict=True)]
    return _TEXT.figure("noise", figure, rows, ("row", "column", "noise x", "noise y"))


def _spectra_figure(report: LoopReport) -> FigureWithData | None:
    """Draw spectra of open-loop slopes and of the fitted model."""
    spectra = report.spectra
    if spectra is None:
        return None
    panels: list[Panel] = []
    rows: list[tuple[object, ...]] = []
    unit = f"slope² ({report.loop.slope_unit}²/Hz)"
    for name in spectra.measured:
        measured, model = (report.loop.unit**2 * power[name] for power in (spectra.measured, spectra.model))
        factor = np.exp(1.96 / np.sqrt(0.55 * spectra.pieces))
        scatter = model - model / factor, model * factor - model
        lines = [
            Line("measured", spectra.frequency_hz, measured, style={"color": GREY, "lw": 1}),
            Line(
                "found",
                spectra.frequency_hz,
                model,
                scatter,
                {"color": METHOD_COLOURS[0], "lw": 1.6},
                band=True,
            ),
        ]
        panels.append(Panel(lines, "frequency (Hz)", unit, name, log=True, legend=True))
        rows += [(name, *row) for row in zip(spectra.frequency_hz, measured, model, strict=True)]
    pairs = [panels[first : first + 2] for first in range(0, len(panels), 2)]
    figure = plot(pairs, 3.6 * len(pairs), legend="")
    return _TEXT.figure("spectra", figure, rows, ("slopes", "frequency", "measured", "found"))
