"""The figures of answers: slope error against brightness; Strehl ratios against magnitude, and the sky."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import FLUX_GREY, note, styled
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.experiments.closed_loop.figures import method_style
from faintspot.experiments.closed_loop.question import MODEL_ERROR, PLACES
from faintspot.experiments.planner import text as answer_text
from faintspot.loop.control.identification.models import INTEGRATOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from faintspot.experiments.closed_loop.answer import LoopAnswer
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
    has_sky = answer.question.radius is not None
    panels = [_strehl_panel(answer), *([Panel([], "")] if has_sky else [])]
    names = {
        name: f"{name} (recommended)" if kind is answer.best else name for name, kind in answer.kinds.items()
    }
    figure = plot(
        [panels],
        _LOOP_HEIGHT,
        width=_LOOP_WIDTH,
        columns=len(names),
        handles=[Line(label, [], [], style=method_style(name)) for name, label in names.items()],
        width_ratios=(1.25, 1.0)[: len(panels)],
    )
    left = figure.axes[0]
    words, position = f"Strehl {answer.level:.2f}: limiting magnitudes", (0.01, answer.level)
    note(left, words, position, "axes fraction, data", xytext=(0, 3), color="#666666")
    if answer.question.configuration.photons in answer.photons:
        text_at = (answer.magnitudes[answer.at_star], 0.99)
        note(left, "the star", text_at, "data, axes fraction", xytext=(4, -10))
    if has_sky:
        _draw_sky(figure.axes[1], answer)
    return figure


def _strehl_panel(answer: LoopAnswer) -> Panel:
    """Return the curves, the ratios that were measured and the limiting magnitudes of all methods."""
    magnitudes, loop = answer.magnitudes, answer.question.configuration
    lines = []
    for name in answer.kinds:
        drawn = method_style(name)
        values = [answer.strehl(name, flux) for flux in range(len(magnitudes))]
        errors = [strehl.standard_error for strehl in values]
        bars = {**drawn, "lw": 0, "elinewidth": 1.2, "capsize": 2.5}
        lines.append(Line("", magnitudes, answer.curve(name), style={**drawn, "marker": ""}))
        lines.append(Line("", magnitudes, [strehl.value for strehl in values], errors, bars))
        limit = answer.limit(name)
        if limit.is_known:
            mark = {"color": drawn["color"], "marker": "|", "ms": 16, "mew": 2.2, "lw": 0, "elinewidth": 2.2}
            place = [limit.magnitude.value], [answer.level]
            lines.append(Line("", *place, style={**mark, "zorder": 5}, x_error=[limit.error]))
    star = {"color": "black", "lw": 0.8, "ls": ":", "zorder": 0}
    return Panel(
        lines,
        f"guide star magnitude ({loop.camera.band}); markers are measured, lines interpolated",
        f"Strehl ratio at {1e6 * loop.science.wavelength_m:.3g} µm",
        y_range=(0, 1),
        levels={answer.level: {"zorder": 0}},
        at={magnitudes[answer.at_star]: star} if loop.photons in answer.photons else {},
        above=(magnitudes, answer.photons.tolist(), "photo-electrons per sub-aperture and frame"),
        grid=True,
    )


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
