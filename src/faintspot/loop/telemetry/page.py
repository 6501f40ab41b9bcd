"""Page of a recorded loop: pictures and tables with errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from faintspot.base.report.drawing import GREY, METHOD_COLOURS, WIDTH, colour_bar, new_figure, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import Report, Table
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.base.report.texts import Texts
from faintspot.loop.control.identification.measured import R0, Measured, wind_errors
from faintspot.loop.telemetry.choices import AS_RUN, BEST, FILTER
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
        "turbulence": _wind_figure,
        "spectra": _spectra_figure,
        "choices": _gain_figure,
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


@styled
def _wind_figure(report: LoopReport) -> FigureWithData | None:
    """Draw the wind of each layer, with errors."""
    identified = report.turbulence
    if identified is None or report.loop.subaperture_m is None or not identified.is_layered:
        return None
    figure = new_figure(WIDTH * 0.5, 5.4)
    axes = figure.subplots()
    winds, errors = identified.turbulence.wind_m_per_s, wind_errors(identified)
    share = identified.turbulence.fraction
    reach = 1.25 * float(np.hypot(*winds.T).max())
    for radius in np.arange(5, reach, 5):
        angle = np.linspace(0, 2 * np.pi, 181)
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=GREY, lw=0.6, ls=":")
    x, y = winds.T
    axes.errorbar(x, y, 1.96 * errors[:, 1], 1.96 * errors[:, 0], fmt="none", color=GREY, capsize=2)
    axes.scatter(x, y, 900 * share, color=METHOD_COLOURS[1], alpha=0.7)
    for wind, part in zip(winds, share, strict=True):
        axes.annotate(f"{part:.0%}", wind, textcoords="offset points", xytext=(12, 8))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel="wind along x (m/s)", ylabel="wind along y (m/s)")
    rows = [(*wind, *error, part) for wind, error, part in zip(winds, errors, share, strict=True)]
    return _TEXT.figure("winds", figure, rows, ("x", "y", "error of x", "error of y", "share"))


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


def _gain_figure(report: LoopReport) -> FigureWithData | None:
    """Draw the residual of integrators against gain, and those of the loop and the filter."""
    curve = [choice for choice in report.choices if np.isfinite(choice.gain) and choice.name != BEST]
    curve = [choice for choice in curve if np.isfinite(choice.residual.value)]
    if not curve:
        return None
    values = [(choice.gain, choice.residual.value, choice.residual.error) for choice in curve]
    gain, residual, error = np.array(values).T
    lines = [Line("integrator", gain, residual, 1.96 * error, _MEASURED)]
    for name, colour in ((AS_RUN, "black"), (FILTER, METHOD_COLOURS[0])):
        for choice in (choice for choice in report.choices if choice.name == name):
            level, ends = choice.residual.value, np.array(choice.residual.interval)
            spread = np.repeat(np.abs(ends - level)[:, None], 2, axis=1)
            across = [gain.min(), gain.max()]
            lines.append(Line(name, across, [level, level], spread, {"color": colour}, band=True))
    label = f"residual ({curve[0].residual.unit})"
    panel = Panel(lines, "gain of an integrator", label, y_range=(0, None), legend=True)
    figure = plot([[panel]], 4.4, width=WIDTH * 0.7, legend="")
    return _TEXT.figure("gains", figure, values, ("gain", "residual", "standard error"))
