"""The figures of the closed-loop report: what is drawn, what it is in words, and its numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.report.drawing import GREY, WIDTH, axis_above, new_figure, plain_ticks, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.methods import CONTROL_SIGN
from faintspot.experiments.closed_loop.results import BudgetResult, MagnitudeResult, differences_by_flux
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.registry import estimators

_TEXT = Texts("faintspot.experiments")
_STREHL = "H-band Strehl ratio"
_DODGE = 0.008  # of the axis, between methods at the same magnitude
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))


def strehl_axis(wavelength_m: float) -> str:
    """Return the label of an axis of Strehl ratios."""
    return _STREHL if 1.5e-6 <= wavelength_m <= 1.8e-6 else f"Strehl ratio at {wavelength_m * 1e6:.3g} µm"


@styled
def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> FigureWithData:
    """Draw Strehl against magnitude for every method, and what each gains over the reference."""
    figure = new_figure(WIDTH, 6.4)
    left, right = figure.subplots(1, 2)
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    rows = []
    for method, name in enumerate(result.labels):
        runs = [paired_mean(values) for values in result.strehl[method]]
        value = np.array([run.value for run in runs])
        error = np.nan_to_num([run.standard_error for run in runs])
        shifted = result.magnitudes + (method - len(result.labels) / 2) * shift
        style = method_style(result.names[method])
        left.errorbar(result.magnitudes, value, error, label=name, capsize=2, **style)
        differences = differences_by_flux(result, method, reference)
        low, middle, high = np.array([[d.low, d.value, d.high] for d in differences]).T
        if method != reference:
            right.errorbar(shifted, middle, np.nan_to_num([middle - low, high - middle]), capsize=2, **style)
        count = np.full(len(value), result.strehl.shape[-1])
        columns = result.magnitudes, result.photons, value, error, count, low, middle, high
        rows += [[name, *row] for row in zip(*columns, strict=True)]
    right.axhline(0, color=GREY, lw=1)
    left.set(xlabel="guide-star magnitude", ylabel=label)
    left.set_ylim(bottom=0)
    than = f"Strehl ratio minus that of {result.labels[reference]}, paired"
    right.set(xlabel="guide-star magnitude", ylabel=than)
    for panel in (left, right):
        label_above = "photo-electrons of a sub-aperture in a frame"
        axis_above(panel, result.magnitudes, result.photons, label_above).tick_params(labelsize=10)
    figure.legend(loc="outside lower center", ncols=min(4, len(result.labels)), frameon=False)
    return _TEXT.figure("magnitude", figure, rows)


@styled
def gain_figure(result: MagnitudeResult) -> FigureWithData:
    """Draw the centroid gain of every method against the star's flux."""
    figure = new_figure(WIDTH * 0.7, 5.2)
    panel = figure.subplots()
    rows = []
    for method, name in enumerate(result.labels):
        value = np.array([paired_mean(values).value for values in result.centroid_gain[method]])
        panel.plot(result.photons, value, label=name, **method_style(result.names[method]))
        rows += [[name, p, v] for p, v in zip(result.photons, value, strict=True)]
    panel.axhline(1, color=GREY, lw=1)
    panel.set_xscale("log")
    plain_ticks(panel.xaxis, result.photons, ".3g")
    panel.set(xlabel="photo-electrons of a sub-aperture in a frame", ylabel="centroid gain")
    panel.set_ylim(bottom=0)
    figure.legend(loc="outside right upper", frameon=False)
    return _TEXT.figure("gain", figure, rows)


@styled
def budget_figure(result: BudgetResult, label: str) -> FigureWithData:
    """Draw the Strehl ratio of every method with each term of the error budget switched off."""
    terms, methods = len(result.terms), len(result.labels)
    figure = new_figure(WIDTH * 0.8, 1.6 + 0.2 * terms * (methods + 1))
    panel = figure.subplots()
    rows = []
    for method, name in enumerate(result.labels):
        runs = [paired_mean(values) for values in result.strehl[method]]
        value = np.array([run.value for run in runs])
        error = np.nan_to_num([run.standard_error for run in runs])
        y = np.arange(terms) + (method - (methods - 1) / 2) * 0.8 / methods
        colour = method_style(result.names[method])["color"]
        panel.barh(y, value, 0.72 / methods, xerr=error, color=colour, label=name, capsize=2, ecolor=GREY)
        panel.plot([value[0]] * 2, [-0.5, terms - 0.5], color=colour, lw=0.8, ls=":")
        rows += [[name, t, v, e] for t, v, e in zip(result.terms, value, error, strict=True)]
    panel.set_yticks(range(terms), [_switched(term) for term in result.terms])
    panel.invert_yaxis()
    panel.set(xlabel=label)
    figure.legend(loc="outside lower center", ncols=min(3, methods), frameon=False)
    return _TEXT.figure("budget", figure, rows)


def _switched(term: str) -> str:
    return "whole loop" if term == "nothing" else f"without {term}"


def method_style(name: str) -> dict[str, Any]:
    """Return the style of a method's estimator; markers are hollow where the loop does more than the usual.

    Lines of control that learns are dash-dotted.
    """
    kinds = estimators()
    base = next((name[:end] for end in range(len(name), 0, -1) if name[:end] in kinds), "")
    style = kinds[base].style if base else Style("#666666")
    return {
        "color": style.colour,
        "marker": style.marker,
        "ms": 6,
        "mfc": style.colour if name == base else "white",
        "lw": 1.5,
        "ls": _LEARNING_LINE if CONTROL_SIGN in name else style.line,
    }
