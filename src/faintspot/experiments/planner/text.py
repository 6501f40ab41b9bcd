"""The planner's answer in words."""

from __future__ import annotations

import math
from typing import Any

from faintspot.base.report.texts import Texts
from faintspot.base.report.words import plain_number, with_error
from faintspot.base.statistics import Estimate
from faintspot.experiments.methods import Knowledge
from faintspot.experiments.planner.answer import Answer, MethodResult, settings_in_words
from faintspot.experiments.planner.question import Question
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation

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
        star = f"{question.photometry.band} = {_magnitude(answer, question.star_flux_e):.2f}, {star}"
    kind = f"{question.profile} spots" if question.psf is None else "spots as learnt"
    if question.laser is not None:
        kind = "spots of a laser guide star"
    if question.d_over_r0:
        kind = f"speckled spots (sub-aperture {question.d_over_r0:.2g} r0)"
    return _TEXT("answer.situation", star=star, kind=kind, question=question)


def recommendation(answer: Answer) -> list[str]:
    """Return the recommendation in a few sentences, the first a heading."""
    best = answer.best
    lines = [f"Recommended: {best.method.label} ({settings_in_words(best.settings)})"]
    if answer.is_hopeless:
        rms = best.statistics.corrected_rms.value
        lines.append(
            _TEXT("answer.too_faint", rms=rms, prior=answer.prior_rms_px, subject=answer.question.subject)
        )
    if best.method.name != BRIGHTEST:
        gains = (gain_in_words(answer, gain) for gain in (best.over_brightest, best.over_thresholded))
        lines.append(_TEXT("answer.saves", **dict(zip(("brightest", "thresholded"), gains, strict=True))))
    others = [answer[name].method.label for name in answer.equal[1:]]
    if others:
        lines.append(_TEXT("answer.as_good", others=", ".join(others)))
    lines += _about_tv(answer)
    gain = best.statistics.gain.value
    if gain < _LOW_GAIN:
        lines.append(_TEXT("answer.low_gain", gain=gain))
    alternative = answer.best_without_psf
    if Knowledge.of(best.method.estimator) == Knowledge.SPOT:
        words = {"label": alternative.method.label, "settings": settings_in_words(alternative.settings)}
        gained = gain_in_words(answer, alternative.over_brightest)
        lines.append(_TEXT("answer.without_spot", **words, gain=gained))
    return lines + _limiting(answer) + promise_lines(answer)


def promise_lines(answer: Answer) -> list[str]:
    """Describe how the recording compares with the promised error."""
    promise = answer.promise
    if promise is None:
        return [UNCHECKED] if answer.question.facts else []
    errors = {"expected": promise.expected_px, "promised": promise.promised_px}
    text = _TEXT(
        "answer.checked",
        flux=plain_number(promise.flux_e),
        predicted=with_error(promise.predicted, 4),
        measured=with_error(promise.measured, 4),
        ratio=promise.noise_ratio,
    )
    if math.isfinite(promise.frame_to_frame.value):
        text += _TEXT("answer.frame_to_frame", error=with_error(promise.frame_to_frame, 4))
    if not promise.contradicted and promise.expected_px > _PLACED * promise.promised_px:
        text += _TEXT("answer.placed", **errors)
    lines = [text]
    simulated = min(answer.results, key=lambda result: result.statistics.ranking_rms)
    factor = answer.promises[simulated.method.name].factor
    if factor > 1 and simulated is not answer.best:
        lines.append(_TEXT("answer.contradicted_best", label=simulated.method.label, factor=factor))
    if promise.contradicted:
        why = " (pixels have another noise than was taken)" if promise.noise_differs else ""
        expected = _TEXT("answer.expect", **errors)
        if promise.factor == 1:
            expected = _TEXT("answer.not_corrected", **errors)
        lines.append(f"{CONTRADICTED}: {expected}{why}")
    return lines


def foundations(answer: Answer) -> list[str]:
    """Describe what the answer is based on."""
    question = answer.question
    spots = f"{answer.realisations} simulated spots at each of {len(answer.flux_e)} fluxes"
    lines = list(question.facts)
    if question.laser is not None:
        lines.append(question.laser.in_words(question.pixel_scale_arcsec, question.shape))
    lines.append(_shape(question, spots))
    lines.append(_TEXT["answer.positions"])
    if question.photometry is not None:
        lines.append(_TEXT("answer.photometry", flux=question.photometry))
    if question.d_over_r0:
        lines.append(_TEXT["answer.bound"])
    lines += [f"{name} was not tried: {reason}" for name, reason in answer.left_out.items()]
    return lines


def _shape(question: Question, spots: str) -> str:
    """Describe the shape of the spots, and who knows it."""
    if question.laser is not None:
        return _TEXT("answer.laser_psf", spots=spots)
    if question.psf is not None:
        return _TEXT("answer.learnt_psf", spots=spots)
    return _TEXT("answer.assumed_profile", spots=spots, profile=question.profile)


def gain_in_words(answer: Answer, gain: Estimate) -> str:
    """Return magnitudes gained, `more than` what the plot spans where beyond."""
    if math.isfinite(gain.value):
        return f"{with_error(gain, 2, smallest=_SMALLEST_ERROR_MAG)} mag"
    span = _span(answer)
    return f"more than {span:.1f} mag" if gain.value > 0 else f"-{span:.1f} mag or less"


def short_gain(answer: Answer, gain: Estimate) -> str:
    """Return the same for a table."""
    if math.isfinite(gain.value):
        return with_error(gain, 2, sign=True, smallest=_SMALLEST_ERROR_MAG).replace(" ", "")
    return f">+{_span(answer):.1f}" if gain.value > 0 else f"<-{_span(answer):.1f}"


def _span(answer: Answer) -> float:
    return float(2.5 * math.log10(answer.flux_e[-1] / answer.question.star_flux_e))


def _about_tv(answer: Answer) -> list[str]:
    """Describe the gain of TV where it is not recommended."""
    tv, best = answer[TV], answer.best
    if tv is best:
        return []
    times = tv.method.estimator.cost / best.method.estimator.cost
    gain = tv.over_brightest
    if not math.isfinite(gain.value):
        helps = gain.value > 0
    else:
        helps = gain.value > max(_HELPS_ABOVE_MAG, 2 * gain.standard_error)
    if not helps:
        return [_TEXT("answer.tv_does_not", gain=gain_in_words(answer, gain))]
    saved = gain_in_words(answer, gain)
    return [_TEXT("answer.tv_saves", gain=saved, times=times, label=best.method.label)]


def below_bound(answer: Answer) -> str:
    """Return why methods lie below the Cramer-Rao bound, where always answering the reference is worse."""
    drawn = answer.bound_px < answer.question.search_range_px / 2
    labels = [
        result.method.label
        for result in answer.results
        if (drawn & (result.error_px + 2 * result.standard_error_px < answer.bound_px)).any()
    ]
    if not labels:
        return ""
    reach = answer.question.search_range_px
    return _TEXT("answer.below_bound", labels=", ".join(labels), reach=reach)


def _limiting(answer: Answer) -> list[str]:
    """Return the limiting magnitudes of the recommended method and of brightest pixels."""
    budget = answer.question.budget_px
    if budget is None:
        return []
    brightest = answer[BRIGHTEST]
    text = f"for R = {budget:.3g} px: {_limit(answer, answer.best)}"
    if answer.best is not brightest:
        text += f"; with brightest pixels {_limit(answer, brightest)}"
    return [f"limiting {'magnitude' if answer.question.photometry else 'flux'} {text}"]


def _limit(answer: Answer, result: MethodResult) -> str:
    limit: Any = result.limiting_flux_e
    if limit.value == 0:
        return f"fainter than all that was tried ({_star(answer, answer.flux_e[0])})"
    if math.isinf(limit.value):
        return f"brighter than all that was tried ({_star(answer, answer.flux_e[-1])})"
    if answer.question.photometry is None:
        return f"{plain_number(limit.value)} ± {plain_number(limit.standard_error, 1)} electrons"
    error = 2.5 / math.log(10) * limit.standard_error / limit.value
    return f"{_magnitude(answer, limit.value):.2f} ± {error:.2f}"


def _star(answer: Answer, flux_e: float) -> str:
    if answer.question.photometry is None:
        return f"{plain_number(flux_e)} electrons"
    return f"{_magnitude(answer, flux_e):.2f}"


def _magnitude(answer: Answer, flux_e: float) -> float:
    return float(answer.magnitudes(flux_e))
