"""The figures of answers: slope error against brightness; Strehl ratios against magnitude, and the sky."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import FLUX_GREY, GREY, axis_above, new_figure, note, plain_ticks, styled
from faintspot.experiments.closed_loop.figures import method_style
from faintspot.experiments.closed_loop.question import MODEL_ERROR, PLACES
from faintspot.experiments.planner import text as answer_text
from faintspot.loop.control.identification.learning import INTEGRATOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from faintspot.experiments.closed_loop.answer import LoopAnswer
    from faintspot.experiments.planner.answer import Answer


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
    figure = new_figure(_WIDTH, _HEIGHT)
    axes = figure.subplots()
    magnitudes = answer.magnitudes(answer.flux_e)
    for result in answer.results:
        _draw_method(axes, answer, result, magnitudes)
    saturated = answer.question.search_range_px / 2
    bound = np.where(answer.bound_px < 1.5 * saturated, answer.bound_px, np.nan)
    axes.plot(magnitudes, bound, color="black", lw=1.3, label="Cramér-Rao bound, without a prior", zorder=6)
    axes.axhline(saturated, color=GREY, lw=1, ls=(0, (1, 4)), label="always the reference")
    axes.set_yscale("log")
    _axis_limits(axes, answer, saturated)
    _mark_star(axes, answer)
    _mark_budget(axes, answer)
    axis_above(axes, magnitudes, answer.flux_e, "electrons per sub-aperture and frame")
    plain_ticks(axes.yaxis, _TICKS)
    axes.grid(which="major", color=FLUX_GREY, lw=0.7)
    if answer.promise is not None and answer.promise.contradicted:
        title = textwrap.fill(answer_text.promise_lines(answer)[-1], _TITLE_LETTERS)
        axes.set_title(title, color="#b00020", loc="left")
    why = textwrap.fill(answer_text.below_bound(answer), _NOTE_LETTERS)
    axes.text(1.03, 0.0, why, transform=axes.transAxes, color="#666666", fontsize=10, va="bottom")
    axes.set_xlabel(answer.magnitude_label)
    axes.set_ylabel("slope error R, mean |error| per axis (px)")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0)
    return figure


def _draw_method(axes: Axes, answer: Any, result: Any, magnitudes: NDArray[np.float64]) -> None:
    style = result.method.estimator.style
    best = result is answer.best
    axes.errorbar(
        magnitudes,
        result.error_px,
        result.standard_error_px,
        color=style.colour,
        ls=style.line,
        marker=style.marker,
        ms=7 if best else 5,
        lw=3 if best else 1.6,
        elinewidth=1,
        zorder=4 if best else 3,
        label=f"{result.method.label} (recommended)" if best else result.method.label,
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
    note(axes, f"the {answer.question.subject}", (where, 0.015), "data, axes fraction", xytext=(4, 0))


def _mark_budget(axes: Axes, answer: Any) -> None:
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
    style: dict[str, Any] = {"color": "#8a5f00", "weight": "bold"}
    note(axes, f"limit {magnitude:.2f}", (magnitude, budget), "data", xytext=(12, -16), **style)


_LOOP_WIDTH, _LOOP_HEIGHT = 13.0, 5.6


@styled
def loop_figure(answer: LoopAnswer) -> Figure:
    """Draw Strehl ratios with errors and limiting magnitudes, and the sky coverage if its radius is given.

    Parameters
    ----------
    answer : LoopAnswer

    Examples
    --------
    >>> from faintspot.experiments import loop_figure
    >>> figure = loop_figure(answer)  # of tune_loop  # doctest: +SKIP
    """
    figure = new_figure(_LOOP_WIDTH, _LOOP_HEIGHT)
    if answer.question.radius is None:
        left = figure.subplots()
    else:
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
        _draw_sky(right, answer)
    _draw_strehl(left, answer)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _draw_strehl(axes: Axes, answer: LoopAnswer) -> None:
    magnitudes = answer.magnitudes
    for name, kind in answer.kinds.items():
        drawn = method_style(name)
        label = f"{name} (recommended)" if kind is answer.best else name
        axes.plot(magnitudes, answer.curve(name), **{**drawn, "marker": ""})
        axes.plot([], [], label=label, **drawn)
        values = [answer.strehl(name, flux) for flux in range(len(magnitudes))]
        errors = [strehl.standard_error for strehl in values]
        bars = {**drawn, "lw": 0, "elinewidth": 1.2, "capsize": 2.5}
        axes.errorbar(magnitudes, [strehl.value for strehl in values], errors, **bars)
        limit = answer.limit(name)
        if limit.is_known:
            error = limit.error if np.isfinite(limit.error) else 0.0
            mark = {"color": drawn["color"], "marker": "|", "ms": 16, "mew": 2.2, "lw": 0, "elinewidth": 2.2}
            axes.errorbar(limit.magnitude.value, answer.level, xerr=error, zorder=5, **mark)
    axes.axhline(answer.level, color=GREY, lw=1, zorder=0)
    words, position = f"Strehl {answer.level:.2f}: limiting magnitudes", (0.01, answer.level)
    note(axes, words, position, "axes fraction, data", xytext=(0, 3), color="#666666")
    if answer.question.configuration.photons in answer.photons:
        axes.axvline(magnitudes[answer.at_star], color="black", lw=0.8, ls=":", zorder=0)
        text_at = (magnitudes[answer.at_star], 0.99)
        note(axes, "the star", text_at, "data, axes fraction", xytext=(4, -10))
    axes.set_ylim(0, 1)
    axes.grid(color=FLUX_GREY, lw=0.7)
    loop = answer.question.configuration
    axes.set_xlabel(f"guide star magnitude ({loop.camera.band}); markers are measured, lines interpolated")
    axes.set_ylabel(f"Strehl ratio at {1e6 * loop.science.wavelength_m:.3g} µm")
    axis_above(axes, magnitudes, answer.photons, "photo-electrons per sub-aperture and frame")


def _draw_sky(axes: Axes, answer: LoopAnswer) -> None:
    """Draw the fraction of the sky: thick error bars are the limits', thin ones with the star counts'."""
    width = 0.8 / len(answer.kinds)
    for number, (name, kind) in enumerate(answer.kinds.items()):
        drawn = method_style(name)
        for group, place in enumerate(PLACES):
            coverage = answer.coverage(name, place)
            assert coverage is not None
            x, value = group + (number + 0.5) * width - 0.4, 100 * coverage.fraction
            error = 100 * np.nan_to_num(coverage.strehl_error)
            total = float(np.hypot(error, 100 * coverage.model_error))
            axes.bar(
                x,
                value,
                width * 0.9,
                color=drawn["color"],
                alpha=0.75,
                hatch="//" if kind.control != INTEGRATOR else "",
                ec="white",
            )
            axes.errorbar(x, value, min(total, 0.95 * value), color="black", lw=0, elinewidth=0.8)
            axes.errorbar(x, value, min(error, 0.95 * value), color="black", lw=0, elinewidth=3)
            if coverage.bound:
                axes.annotate(
                    "≥" if coverage.bound > 0 else "≤",
                    (x, value + total),
                    ha="center",
                    va="bottom",
                    fontsize=12,
                )
    axes.set_yscale("log")
    axes.set_xticks(range(len(PLACES)), [place.replace(" degrees", "°") for place in PLACES])
    axes.set_ylabel(f"sky with such a star within {answer.question.radius:.3g}″ (%)")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.grid(axis="y", color=FLUX_GREY, lw=0.7)
    axes.set_axisbelow(True)
    axes.set_title(
        f"thick: error of the limits; thin: with {100 * MODEL_ERROR:.0f} % of the star counts, common to all",
        fontsize=10,
        loc="left",
        color="#666666",
    )
