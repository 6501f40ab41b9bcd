"""The planner's figure for a closed loop: Strehl ratios against magnitude, and what they open of the sky."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.control.learning import INTEGRATOR
from faintspot.planner.loop_question import SECOND
from faintspot.planner.sky import MODEL_ERROR, PLACES
from faintspot.report.drawing import GREY, LIGHT_GREY, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from faintspot.planner.loop_answer import LoopAnswer, LoopArmResult

_WIDTH, _HEIGHT = 13.0, 5.6
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))


@styled
def loop_figure(answer: LoopAnswer) -> Figure:
    """Draw Strehl ratios with errors and limiting magnitudes; where there is a radius, bars of the sky."""
    figure = new_figure(_WIDTH, _HEIGHT)
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
    for result in answer.results:
        drawn = _look(result)
        axes.plot(magnitudes, answer.curve(result.name), lw=1.6, color=drawn["color"], ls=drawn["ls"])
        values = [answer.strehl(result.name, flux) for flux in range(len(magnitudes))]
        axes.errorbar(
            magnitudes,
            [each.value for each in values],
            [each.standard_error for each in values],
            lw=0,
            elinewidth=1.2,
            capsize=2.5,
            color=drawn["color"],
            marker=drawn["marker"],
            mfc=drawn["mfc"],
            ms=6,
        )
        limit = answer.limit(result.name)
        if limit.is_known:
            error = limit.error if np.isfinite(limit.error) else 0.0
            axes.errorbar(limit.magnitude.value, answer.level, xerr=error, **_limit_mark(drawn), zorder=5)
        name = f"{result.name} (recommended)" if result is answer.best else result.name
        axes.plot([], [], label=name, lw=1.6, ms=6, **drawn)
    axes.axhline(answer.level, color=GREY, lw=1, zorder=0)
    axes.annotate(
        f"Strehl {answer.level:.2f}: limiting magnitudes",
        (0.99, answer.level),
        xycoords=("axes fraction", "data"),
        xytext=(0, 3),
        textcoords="offset points",
        ha="right",
        color="#666666",
    )
    if answer.question.configuration.photons in answer.photons:
        axes.axvline(magnitudes[answer.at_star], color="black", lw=0.8, ls=":", zorder=0)
        where = (magnitudes[answer.at_star], 0.99)
        axes.annotate(
            "the star", where, xycoords=("data", "axes fraction"), xytext=(4, -10), textcoords="offset points"
        )
    axes.set_ylim(0, 1)
    axes.grid(color=LIGHT_GREY, lw=0.7)
    loop = answer.question.configuration
    axes.set_xlabel(f"guide star magnitude ({loop.camera.band}); markers are measured, lines interpolated")
    axes.set_ylabel(f"Strehl ratio at {1e6 * loop.science.wavelength_m:.3g} µm")
    top = axes.secondary_xaxis("top")
    top.set_xticks(magnitudes, [f"{float(f'{flux:.3g}'):g}" for flux in answer.photons])
    top.set_xlabel("photo-electrons per sub-aperture and frame")


def _draw_sky(axes: Axes, answer: LoopAnswer) -> None:
    """Draw the fraction of the sky: thick error bars are the limits', thin ones with the star counts'."""
    width = 0.8 / len(answer.results)
    for number, result in enumerate(answer.results):
        drawn = _look(result)
        for group, place in enumerate(PLACES):
            found = answer.coverage(result.name, place)
            assert found is not None
            where, value = group + (number + 0.5) * width - 0.4, 100 * found.fraction
            own = 100 * np.nan_to_num(found.strehl_error)
            both = float(np.hypot(own, 100 * found.model_error))
            learns = result.kind.control != INTEGRATOR
            axes.bar(
                where,
                value,
                width * 0.9,
                color=drawn["color"],
                alpha=0.75,
                hatch="//" if learns else "",
                ec="white",
            )
            axes.errorbar(where, value, min(both, 0.95 * value), color="black", lw=0, elinewidth=0.8)
            axes.errorbar(where, value, min(own, 0.95 * value), color="black", lw=0, elinewidth=3)
            if found.bound:
                axes.annotate(
                    "≥" if found.bound > 0 else "≤",
                    (where, value + both),
                    ha="center",
                    va="bottom",
                    fontsize=12,
                )
    axes.set_yscale("log")
    axes.set_xticks(range(len(PLACES)), [place.replace(" degrees", "°") for place in PLACES])
    axes.set_ylabel(f"sky with such a star within {answer.question.radius:.3g}″ (%)")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.grid(axis="y", color=LIGHT_GREY, lw=0.7)
    axes.set_axisbelow(True)
    axes.set_title(
        f"thick: error of the limits; thin: with {100 * MODEL_ERROR:.0f} % of the star counts, common to all",
        fontsize=10,
        loc="left",
        color="#666666",
    )


def _look(result: LoopArmResult) -> dict[str, Any]:
    """Return colour, line and marker: the estimator's, open and dash-dotted where control learns."""
    style = result.kind.estimator.style
    colour = GREY if result.kind.estimator.name == SECOND else style.colour
    learns = result.kind.control != INTEGRATOR
    return {
        "color": colour,
        "ls": _LEARNING_LINE if learns else style.line,
        "marker": style.marker,
        "mfc": "white" if learns else colour,
    }


def _limit_mark(drawn: dict[str, Any]) -> dict[str, Any]:
    return {"color": drawn["color"], "marker": "|", "ms": 16, "mew": 2.2, "lw": 0, "elinewidth": 2.2}
