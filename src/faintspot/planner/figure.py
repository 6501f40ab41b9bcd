"""The planner's figure: the slope error against the star's brightness."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.planner import answer_text
from faintspot.report.drawing import GREY, LIGHT_GREY, new_figure, plain_ticks, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_WIDTH, _HEIGHT = 10.5, 6.6
_TICKS = (0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 3, 5)


@styled
def tune_figure(answer: Any) -> Figure:
    """Draw R of every arm and the bound against the star's magnitude, and the limiting magnitude.

    `answer` is a `faintspot.planner.Answer`, whose module calls this one.
    """
    figure = new_figure(_WIDTH, _HEIGHT)
    axes = figure.subplots()
    place = answer.magnitudes(answer.flux_e)
    for result in answer.results:
        _draw_arm(axes, answer, result, place)
    saturated = answer.question.search_range_px / 2
    bound = np.where(answer.bound_px < 1.5 * saturated, answer.bound_px, np.nan)
    axes.plot(place, bound, color="black", lw=1.3, label="Cramér-Rao bound", zorder=6)
    axes.axhline(saturated, color=GREY, lw=1, ls=(0, (1, 4)), label="always the reference")
    axes.set_yscale("log")
    _axis_limits(axes, answer, saturated)
    _mark_star(axes, answer)
    _mark_budget(axes, answer)
    _electrons_above(axes, answer)
    plain_ticks(axes.yaxis, _TICKS)
    axes.grid(which="major", color=LIGHT_GREY, lw=0.7)
    if answer.promise is not None and answer.promise.contradicted:
        axes.set_title(answer_text.promise_lines(answer)[-1], color="#b00020", loc="left")
    axes.set_xlabel(answer.magnitude_label)
    axes.set_ylabel("slope error R, mean |error| per axis (px)")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0)
    return figure


def _draw_arm(axes: Axes, answer: Any, result: Any, place: NDArray[np.float64]) -> None:
    style = result.arm.estimator.style
    best = result is answer.best
    axes.errorbar(
        place,
        result.error_px,
        result.standard_error_px,
        color=style.colour,
        ls=style.line,
        marker=style.marker,
        ms=7 if best else 5,
        lw=3 if best else 1.6,
        elinewidth=1,
        zorder=4 if best else 3,
        label=f"{result.arm.label} (recommended)" if best else result.arm.label,
    )


def _axis_limits(axes: Axes, answer: Any, saturated: float) -> None:
    drawn = [result.error_px for result in answer.results]
    lowest = min(float(np.min(drawn)), float(answer.bound_px.min()))
    highest = min(float(np.max(drawn)), 2.5 * saturated)
    budget = answer.question.budget_px
    if budget is not None and lowest / 3 < budget < 3 * highest:
        lowest, highest = min(lowest, budget), max(highest, budget)
    axes.set_ylim(lowest / 1.15, highest * 1.15)


def _mark_star(axes: Axes, answer: Any) -> None:
    where = float(answer.magnitudes(answer.question.star_flux_e))
    axes.axvline(where, color="black", lw=0.8, ls=":", zorder=0)
    axes.annotate(
        "the star",
        (where, 0.015),
        xycoords=("data", "axes fraction"),
        xytext=(4, 0),
        textcoords="offset points",
    )


def _mark_budget(axes: Axes, answer: Any) -> None:
    budget, limit = answer.question.budget_px, answer.best.limiting_flux_e
    if budget is None:
        return
    axes.axhline(budget, color="#E69F00", lw=1.4, zorder=0)
    axes.annotate(
        f"budget {budget:.3g} px",
        (0.99, budget),
        xycoords=("axes fraction", "data"),
        xytext=(0, 3),
        textcoords="offset points",
        ha="right",
        color="#8a5f00",
    )
    if limit is None or not 0 < limit.value < math.inf:
        return
    where = float(answer.magnitudes(limit.value))
    axes.plot([where], [budget], "o", ms=13, mfc="none", mec="#E69F00", mew=2.5, zorder=5)
    axes.annotate(
        f"limit {where:.2f}",
        (where, budget),
        xytext=(12, -16),
        textcoords="offset points",
        color="#8a5f00",
        weight="bold",
    )


def _electrons_above(axes: Axes, answer: Any) -> None:
    """Put an axis of electrons on top, at every flux that was simulated."""
    top = axes.secondary_xaxis("top")
    top.set_xticks(answer.magnitudes(answer.flux_e), [f"{float(f'{flux:.3g}'):g}" for flux in answer.flux_e])
    top.set_xlabel("electrons per sub-aperture and frame")
