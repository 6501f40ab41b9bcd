"""The figure of an answer: slope error against brightness."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.plots import Line, Panel, plot
from faintspot.experiments.planner import text as answer_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from faintspot.experiments.planner.answer import Answer, MethodResult


_TICKS = (1e-4, 2e-4, 5e-4, 0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 3, 5)
_BUDGET = "#E69F00"


def tune_figure(answer: Answer) -> Figure:
    """Draw the slope error of every estimator, and the bound, against the star's magnitude.

    Parameters
    ----------
    answer : Answer

    Examples
    --------
    >>> from faintspot.experiments import tune_figure
    >>> figure = tune_figure(answer)  # of faintspot.tune  # doctest: +SKIP
    """
    magnitudes, question = answer.magnitudes(answer.flux_e), answer.question
    budget, limit = question.budget_px, answer.best.limiting_flux_e
    saturated = question.spots.search_range_px / 2
    bound = np.where(answer.bound_px < 1.5 * saturated, answer.bound_px, np.nan)
    lines = [_line(answer, result, magnitudes) for result in answer.results]
    style: dict[str, Any] = {"color": "black", "lw": 1.3, "zorder": 6}
    lines.append(Line("Cramér-Rao bound, without a prior", magnitudes, bound, style=style))
    levels: dict[float, dict[str, Any]] = {saturated: {"ls": (0, (1, 4)), "label": "always the reference"}}
    if budget is not None:
        levels[budget] = {"color": _BUDGET, "lw": 1.4, "zorder": 0, "label": f"budget {budget:.3g} px"}
        if limit is not None and 0 < limit.value < math.inf:
            magnitude = float(answer.magnitudes(limit.value))
            style = {
                "ls": "",
                "marker": "o",
                "ms": 13,
                "mfc": "none",
                "mec": _BUDGET,
                "mew": 2.5,
                "zorder": 5,
            }
            lines.append(Line(f"limit {magnitude:.2f}", [magnitude], [budget], style=style))
    star = {"color": "black", "lw": 0.8, "ls": ":", "zorder": 0, "label": f"the {question.subject}"}
    panel = Panel(
        lines,
        answer.magnitude_label,
        "slope error R, mean |error| per axis (px)",
        y_ticks=_TICKS,
        y_range=_limits(answer, saturated),
        levels=levels,
        at={float(answer.magnitudes(question.star_flux_e)): star},
        above=(magnitudes, answer.flux_e.tolist(), "electrons per sub-aperture and frame"),
        grid=True,
    )
    is_contradicted = answer.promise is not None and answer.promise.contradicted
    warning = textwrap.fill(answer_text.promise_lines(answer)[-1], 100) if is_contradicted else ""
    return plot([[panel]], 6.6, width=10.5, heading=warning, legend="outside right upper", columns=1)


def _line(answer: Answer, result: MethodResult, magnitudes: NDArray[np.float64]) -> Line:
    style, best = result.method.estimator.style, result is answer.best
    drawn = {"color": style.colour, "ls": style.line, "marker": style.marker, "elinewidth": 1}
    drawn |= {"ms": 7, "lw": 3, "zorder": 4} if best else {"ms": 5, "lw": 1.6, "zorder": 3}
    label = f"{result.method.label} (recommended)" if best else result.method.label
    return Line(label, magnitudes, result.error_px, result.standard_error_px, drawn)


def _limits(answer: Answer, saturated: float) -> tuple[float, float]:
    drawn = [result.error_px for result in answer.results]
    lowest = min(float(np.min(drawn)), float(answer.bound_px.min()))
    highest = min(float(np.max(drawn)), 2.5 * saturated)
    budget = answer.question.budget_px
    if budget is not None and lowest / 3 < budget < 3 * highest:
        lowest, highest = min(lowest, budget), max(highest, budget)
    return lowest / 1.15, highest * 1.15
