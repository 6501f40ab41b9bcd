"""The figures of the closed-loop report: what is drawn, what it is in words, and its numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import GREY, WIDTH, new_figure, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.methods import CONTROL_SIGN
from faintspot.experiments.closed_loop.results import BudgetResult, MagnitudeResult, differences_by_flux
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.registry import estimators

_TEXT = Texts("faintspot.experiments")
_STREHL = "H-band Strehl ratio"
_MAGNITUDE = "guide-star magnitude"
_PHOTONS = "photo-electrons of a sub-aperture in a frame"
_DODGE = 0.008  # of the axis, between methods at the same magnitude
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))


def strehl_axis(wavelength_m: float) -> str:
    """Return the label of an axis of Strehl ratios."""
    return _STREHL if 1.5e-6 <= wavelength_m <= 1.8e-6 else f"Strehl ratio at {wavelength_m * 1e6:.3g} µm"


def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> FigureWithData:
    """Draw Strehl against magnitude for every method, and what each gains over the reference."""
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    strehls, differences, rows = [], [], []
    for method, name in enumerate(result.labels):
        value, error = means_of(result.strehl[method])
        style = {**method_style(result.names[method]), "capsize": 2}
        strehls.append(Line(name, result.magnitudes, value, error, style))
        found = differences_by_flux(result, method, reference)
        low, middle, high = np.array([[d.low, d.value, d.high] for d in found]).T
        if method != reference:
            shifted = result.magnitudes + (method - len(result.labels) / 2) * shift
            differences.append(Line("", shifted, middle, (middle - low, high - middle), style))
        count = np.full(len(value), result.strehl.shape[-1])
        columns = result.magnitudes, result.photons, value, error, count, low, middle, high
        rows += [[name, *row] for row in zip(*columns, strict=True)]
    above = result.magnitudes, result.photons.tolist(), _PHOTONS
    than = f"Strehl ratio minus that of {result.labels[reference]}, paired"
    left = Panel(strehls, _MAGNITUDE, label, y_range=(0, None), above=above)
    right = Panel(differences, _MAGNITUDE, than, levels={0.0: {}}, above=above)
    return _TEXT.figure("magnitude", plot([[left, right]], 6.4), rows)


def gain_figure(result: MagnitudeResult) -> FigureWithData:
    """Draw the centroid gain of every method against the star's flux."""
    lines, rows = [], []
    for method, name in enumerate(result.labels):
        value, _ = means_of(result.centroid_gain[method])
        lines.append(Line(name, result.photons, value, style=method_style(result.names[method])))
        rows += [[name, p, v] for p, v in zip(result.photons, value, strict=True)]
    panel = Panel(
        lines,
        _PHOTONS,
        "centroid gain",
        x_ticks=result.photons.tolist(),
        y_range=(0, None),
        levels={1.0: {}},
    )
    figure = plot([[panel]], 5.2, width=WIDTH * 0.7, columns=1, legend="outside right upper")
    return _TEXT.figure("gain", figure, rows)


@styled
def budget_figure(result: BudgetResult, label: str) -> FigureWithData:
    """Draw the Strehl ratio of every method with each term of the error budget switched off."""
    terms, methods = len(result.terms), len(result.labels)
    figure = new_figure(WIDTH * 0.8, 1.6 + 0.2 * terms * (methods + 1))
    panel = figure.subplots()
    rows = []
    for method, name in enumerate(result.labels):
        value, error = means_of(result.strehl[method])
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


def means_of(runs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of each row of runs, and its standard error, 0 where that is not known."""
    means = [paired_mean(values) for values in runs]
    return np.array([mean.value for mean in means]), np.nan_to_num([mean.standard_error for mean in means])


def _switched(term: str) -> str:
    return "whole loop" if term == "nothing" else f"without {term}"


def method_style(name: str) -> dict[str, object]:
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
