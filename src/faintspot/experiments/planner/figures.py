"""The figure of an answer: slope error against brightness."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.plots import Line, Panel, note, plot, styled
from faintspot.experiments.planner import text as answer_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from faintspot.experiments.planner.answer import Answer, MethodResult


_WIDTH, _HEIGHT = 10.5, 6.6
_TITLE_LETTERS, _NOTE_LETTERS = 100, 44  # in a line
_TICKS = (1e-4, 2e-4, 5e-4, 0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 3, 5)


@styled
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
    magnitudes = answer.magnitudes(answer.flux_e)
    saturated = answer.question.search_range_px / 2
    bound = np.where(answer.bound_px < 1.5 * saturated, answer.bound_px, np.nan)
    lines = [_line(answer, result, magnitudes) for result in answer.results]
    style = {"color": "black", "lw": 1.3, "zorder": 6}
    lines.append(Line("Cramér-Rao bound, without a prior", magnitudes, bound, style=style))
    panel = Panel(
        lines,
        answer.magnitude_label,
        "slope error R, mean |error| per axis (px)",
        y_ticks=_TICKS,
        y_range=_limits(answer, saturated),
        levels={saturated: {"ls": (0, (1, 4)), "label": "always the reference"}},
        above=(magnitudes, answer.flux_e.tolist(), "electrons per sub-aperture and frame"),
        grid=True,
    )
    figure = plot([[panel]], _HEIGHT, width=_WIDTH, legend="")
    axes = figure.axes[0]
    _mark_star(axes, answer)
    _mark_budget(axes, answer)
    if answer.promise is not None and answer.promise.contradicted:
        title = textwrap.fill(answer_text.promise_lines(answer)[-1], _TITLE_LETTERS)
        axes.set_title(title, color="#b00020", loc="left")
    why = textwrap.fill(answer_text.below_bound(answer), _NOTE_LETTERS)
    axes.text(1.03, 0.0, why, transform=axes.transAxes, color="#666666", fontsize=10, va="bottom")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0)
    return figure


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


def _mark_star(axes: Axes, answer: Answer) -> None:
    where = float(answer.magnitudes(answer.question.star_flux_e))
    axes.axvline(where, color="black", lw=0.8, ls=":", zorder=0)
    note(axes, f"the {answer.question.subject}", (where, 0.015), "data, axes fraction", xytext=(4, 0))


def _mark_budget(axes: Axes, answer: Answer) -> None:
    budget, limit = answer.question.budget_px, answer.best.limiting_flux_e
    if budget is None:
        return
    axes.axhline(budget, color="#E69F00", lw=1.4, zorder=0)
    words, position = f"budget {budget:.3g} px", (0.99, budget)
    note(axes, words, position, "axes fraction, data", xytext=(0, 3), ha="right", color="#8a5f00")
    if limit is None or not 0 < limit.value < math.inf:
        return
    magnitude = float(answer.magnitudes(limit.value))
    axes.plot([magnitude], [budget], "o", ms=13, mfc="none", mec="#E69F00", mew=2.5, zorder=5)
    style: dict[str, object] = {"color": "#8a5f00", "weight": "bold"}
    note(axes, f"limit {magnitude:.2f}", (magnitude, budget), "data", xytext=(12, -16), **style)
