"""The planner's answer in words."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.base.report.texts import Texts, plain_number, with_error
from faintspot.base.statistics import Estimate
from faintspot.experiments.methods import Knowledge
from faintspot.experiments.planner.answer import Answer, MethodResult, settings_in_words
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from faintspot.base.report.plots import Line
    from faintspot.experiments.planner.answer import Answer, MethodResult


_TEXT = Texts("faintspot.experiments")
BRIGHTEST, TV = BrightestPixels.name, TotalVariation.name

CONTRADICTED = "THE RECORDING CONTRADICTS THE PROMISE"
UNCHECKED = (
    "NOTHING WAS CHECKED on the recording: a single frame cannot both teach and check; give two or more"
)
_HELPS_ABOVE_MAG = 0.02
_LOW_GAIN = 0.9
_PLACED = 1.03  # R at the recording's places over that of even spots, from which it is named
_SMALLEST_ERROR_MAG = 0.01  # that is shown


def situation(answer: Answer) -> str:
    """Describe the star and the spots."""
    question = answer.question
    star = f"{plain_number(question.star_flux_e)} electrons per sub-aperture and frame"
    if question.photometry is not None:
        star = f"{question.photometry.band} = {_star(answer, question.star_flux_e)}, {star}"
    kind = f"{question.spots.profile} spots" if question.psf is None else "spots as learnt"
    if question.laser is not None:
        kind = "spots of a laser guide star"
    if question.spots.d_over_r0:
        kind = f"speckled spots (sub-aperture {question.spots.d_over_r0:.2g} r0)"
    return _TEXT("answer.situation", star=star, kind=kind, question=question)


def recommendation(answer: Answer) -> list[str]:
    """Return the recommendation in a few sentences, the first a heading."""
    best, brightest, tv = answer.best, answer[BRIGHTEST], answer[TV]
    alternative = answer.best_without_psf
    is_better, knows_spot = best is not brightest, Knowledge.of(best.method.estimator) == Knowledge.SPOT
    by_tv, budget = gain_in_words(answer, tv.over_brightest), answer.question.budget_px
    lines = _TEXT.lines(
        "answer.recommendation",
        best=best,
        settings=settings_in_words(best.settings),
        subject=answer.question.subject if answer.is_hopeless else None,
        prior=answer.prior_rms_px,
        over_brightest=gain_in_words(answer, best.over_brightest) if is_better else None,
        over_thresholded=gain_in_words(answer, best.over_thresholded),
        others=", ".join(answer[name].method.label for name in answer.equal[1:]) or None,
        tv_does_not=by_tv if tv is not best and not _helps(tv.over_brightest) else None,
        tv_saves=by_tv if tv is not best and _helps(tv.over_brightest) else None,
        times=tv.method.estimator.cost / best.method.estimator.cost,
        low_gain=best.statistics.gain.value if best.statistics.gain.value < _LOW_GAIN else None,
        without_spot=alternative.method.label if knows_spot else None,
        settings_without=settings_in_words(alternative.settings),
        gain_without=gain_in_words(answer, alternative.over_brightest),
        unit="magnitude" if answer.question.photometry else "flux",
        budget=budget,
        limit=None if budget is None else _limit(answer, best),
        limit_of_brightest=_limit(answer, brightest) if is_better and budget is not None else None,
    )
    return lines + promise_lines(answer)


def promise_lines(answer: Answer) -> list[str]:
    """Describe how the recording compares with the promised error."""
    promise = answer.promise
    if promise is None:
        return [UNCHECKED] if answer.question.recorded.facts else []
    simulated = min(answer.results, key=lambda result: result.statistics.ranking_rms)
    factor = answer.promises[simulated.method.name].factor
    is_placed = not promise.contradicted and promise.expected_px > _PLACED * promise.promised_px
    checked = _TEXT(
        "answer.checked",
        promise,
        flux=plain_number(promise.flux_e),
        moving=promise.frame_to_frame if math.isfinite(promise.frame_to_frame.value) else None,
        placed=is_placed,
    )
    lines = _TEXT.lines(
        "answer.promise",
        promise,
        label=simulated.method.label if factor > 1 and simulated is not answer.best else None,
        factor_of_best=factor,
        contradiction=CONTRADICTED if promise.contradicted else None,
        is_corrected=promise.factor != 1,
        why=" (pixels have another noise than was taken)" if promise.noise_differs else "",
    )
    return [checked, *lines]


def foundations(answer: Answer) -> list[str]:
    """Describe what the answer is based on."""
    question, laser = answer.question, answer.question.laser
    is_learnt = question.psf is not None
    lines = _TEXT.lines(
        "answer.foundations",
        question,
        spots=f"{answer.realisations} simulated spots at each of {len(answer.flux_e)} fluxes",
        laser_words=laser and laser.in_words(question.pixel_scale_arcsec, question.spots.shape),
        laser=laser is not None,
        learnt=is_learnt,
        assumed=laser is None and not is_learnt,
        profile=question.spots.profile,
        speckled=bool(question.spots.d_over_r0),
    )
    not_tried = [f"{name} was not tried: {reason}" for name, reason in answer.left_out.items()]
    return [*question.recorded.facts, *lines, *not_tried]


def gain_in_words(answer: Answer, gain: Estimate, *, sign: bool = False) -> str:
    """Return magnitudes gained, `more than` what the plot spans where beyond."""
    if math.isfinite(gain.value):
        return with_error(gain, 2, sign=sign, smallest=_SMALLEST_ERROR_MAG)
    span = 2.5 * math.log10(answer.flux_e[-1] / answer.question.star_flux_e)
    return f"more than {span:.1f}" if gain.value > 0 else f"less than -{span:.1f}"


def _helps(gain: Estimate) -> bool:
    """Whether a gain is worth a word."""
    if not math.isfinite(gain.value):
        return gain.value > 0
    return gain.value > max(_HELPS_ABOVE_MAG, 2 * gain.standard_error)


def _limit(answer: Answer, result: MethodResult) -> str:
    limit = not_none(result.limiting_flux_e)
    if limit.value == 0:
        return f"fainter than all that was tried ({_star(answer, answer.flux_e[0])})"
    if math.isinf(limit.value):
        return f"brighter than all that was tried ({_star(answer, answer.flux_e[-1])})"
    if answer.question.photometry is None:
        return f"{plain_number(limit.value)} ± {plain_number(limit.standard_error, 1)} electrons"
    return f"{_star(answer, limit.value)} ± {2.5 / math.log(10) * limit.standard_error / limit.value:.2f}"


def _star(answer: Answer, flux_e: float) -> str:
    """Return the brightness of a star, as magnitude if the question has a photometry."""
    if answer.question.photometry is None:
        return f"{plain_number(flux_e)} electrons"
    return f"{float(answer.magnitudes(flux_e)):.2f}"


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
    from faintspot.base.report.plots import Line, Panel, plot  # needs matplotlib

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
    warning = textwrap.fill(promise_lines(answer)[-1], 100) if is_contradicted else ""
    return plot([[panel]], 6.6, width=10.5, heading=warning, legend="outside right upper", columns=1)


def _line(answer: Answer, result: MethodResult, magnitudes: NDArray[np.float64]) -> Line:
    from faintspot.base.report.plots import Line

    style, best = result.method.estimator.style, result is answer.best
    drawn = {"color": style.colour, "ls": style.line, "marker": style.marker, "elinewidth": 1}
    drawn |= {"ms": 7, "lw": 3, "zorder": 4} if best else {"ms": 5, "lw": 1.6, "zorder": 3}
    label = f"{result.method.label} (recommended)" if best else result.method.label
    name, curve = result.method.name, answer.curve
    return Line(label, magnitudes, curve.of(name), curve.se_of(name), drawn)


def _limits(answer: Answer, saturated: float) -> tuple[float, float]:
    lowest = min(float(answer.curve.error.min()), float(answer.bound_px.min()))
    highest = min(float(answer.curve.error.max()), 2.5 * saturated)
    budget = answer.question.budget_px
    if budget is not None and lowest / 3 < budget < 3 * highest:
        lowest, highest = min(lowest, budget), max(highest, budget)
    return lowest / 1.15, highest * 1.15
