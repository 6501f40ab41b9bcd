"""The planner's answer for a closed loop in words."""

from __future__ import annotations

import math

from faintspot.base.report.texts import Texts
from faintspot.base.report.words import plain_number, with_error
from faintspot.experiments.closed_loop.answer import Coverage, LoopAnswer
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, Choice
from faintspot.experiments.closed_loop.question import (
    BASELINE,
    MODEL_ERROR,
    PLACES,
    REFERENCES,
    magnitudes_apart,
)

_TEXT = Texts("faintspot.experiments")
_SMALLEST_ERROR = 0.001


def situation(answer: LoopAnswer) -> str:
    """Describe the loop and the star."""
    loop = answer.question.configuration
    return _TEXT(
        "loop_answer.situation",
        loop=loop,
        noise=loop.camera.read_noise_e / loop.camera.em_gain,
        magnitude=answer.magnitudes[answer.at_star],
        photons=plain_number(answer.photons[answer.at_star]),
    )


def choice_in_words(choice: Choice) -> str:
    """Return tuned values as `name value` pairs, the loop gain first."""
    order = sorted(choice, key=lambda name: name != LOOP_GAIN)
    return ", ".join(
        f"{name} {plain_number(choice[name]) if not isinstance(choice[name], str) else choice[name]}"
        for name in order
    )


def recommendation(answer: LoopAnswer) -> list[str]:
    """Return the recommendation in a few sentences, the first a heading."""
    flux, best = answer.at_star, answer.best
    same = [name for name in answer.equal(flux) if name != best.name]
    against = [
        f"against {reference}: {difference_in_words(answer, best.name, reference)}"
        for reference in REFERENCES
        if reference != best.name
    ]
    heading, *lines = _TEXT.lines(
        "loop_answer.recommendation",
        name=best.name,
        choice=choice_in_words(answer.choice(best.name, flux)),
        strehl=with_error(answer.strehl(best.name, flux), smallest=_SMALLEST_ERROR),
        wavelength_um=1e6 * answer.question.configuration.science.wavelength_m,
        same=", ".join(same) or None,
        taken="the baseline" if best.name == BASELINE else "what is simplest",
    )
    by_star = _TEXT.lines("loop_answer.by_star", stars=_along_the_magnitudes(answer), ends=_ends(answer))
    return [heading, *lines, *against, *by_star]


def difference_in_words(answer: LoopAnswer, name: str, reference: str) -> str:
    """Describe the gain of a method over another, in Strehl ratio and limiting magnitude."""
    difference = answer.difference(name, reference, answer.at_star)
    verdict = {1: "", 0: " (its 95 % interval includes 0)", -1: ", less beyond its error"}[difference.decided]
    text = f"Strehl ratio {with_error(difference, sign=True, smallest=_SMALLEST_ERROR)}{verdict}"
    return f"{text}; limiting magnitude {gain_in_words(answer, name, reference)}"


def gain_in_words(answer: LoopAnswer, name: str, reference: str) -> str:
    """Return the gain in limiting magnitude with its error, or what is known of it."""
    gain = answer.gain(name, reference)
    if gain.is_known:
        return gain.in_words(sign=True)
    limit, reference_limit = (answer.limit(method).magnitude.value for method in (name, reference))
    if math.isinf(limit) and limit == reference_limit:
        return "not within what was measured"
    ends = float(answer.magnitudes[-1]), float(answer.magnitudes[0])
    least = (min(max(limit, ends[0]), ends[1])) - (min(max(reference_limit, ends[0]), ends[1]))
    return f"{'>' if limit > reference_limit else '<'}{least:+.2f}"


def about_the_limits(answer: LoopAnswer) -> str:
    """Explain the table of limiting magnitudes and its errors."""
    seconds = answer.scored_frames / answer.question.configuration.control.frame_rate_hz
    return _TEXT("loop_answer.limiting", level=answer.level, seconds=seconds)


def limit_in_words(answer: LoopAnswer, name: str) -> str:
    """Return a method's limiting magnitude with its error."""
    limit = answer.limit(name)
    if limit.is_known:
        return limit.in_words()
    if limit.magnitude.value > 0:
        return f">{answer.magnitudes[0]:.2f}"
    return f"<{answer.magnitudes[-1]:.2f}"


def coverage_in_words(coverage: Coverage) -> str:
    """Return a fraction of the sky in per cent, with what the Strehl ratio's error makes of it."""
    sign = {1: ">", 0: "", -1: "<"}[coverage.bound]
    value = 100 * coverage.fraction
    if coverage.bound or not math.isfinite(coverage.strehl_error):
        return f"{sign}{plain_number(value, 2)}"
    error = 100 * coverage.strehl_error
    digits = max(0, -math.floor(math.log10(max(error, 1e-3))))
    return f"{value:.{digits}f}±{error:.{digits}f}"


def about_the_sky(answer: LoopAnswer) -> list[str]:
    """Explain the table of sky coverage and its errors."""
    radius = answer.question.radius
    if radius is None:
        return [_TEXT["loop_answer.no_sky"]]
    coverages = {place: answer.coverage(answer.best.name, place) for place in PLACES}
    errors = [
        f"{plain_number(100 * coverage.model_error, 2)} ({place})"
        for place, coverage in coverages.items()
        if coverage
    ]
    return _TEXT.lines(
        "loop_answer.sky",
        answer,
        radius=radius,
        given="given" if answer.question.radius_arcsec is not None else "the isoplanatic angle of the layers",
        percent=100 * MODEL_ERROR,
        errors=", ".join(errors),
    )


def foundations(answer: LoopAnswer) -> list[str]:
    """Describe what the answer is based on."""
    lines = _TEXT.lines(
        "loop_answer.foundations",
        answer,
        measured_at=", ".join(f"{magnitude:.2f}" for magnitude in answer.magnitudes[::-1]),
        fluxes=", ".join(plain_number(flux) for flux in answer.photons[::-1]),
        step=magnitudes_apart(answer.photons.tolist()),
    )
    return lines + [f"{name} was not tried: {reason}" for name, reason in answer.left_out.items()]


def _along_the_magnitudes(answer: LoopAnswer) -> str:
    """Return the recommendation for other stars."""
    parts = []
    for flux in range(len(answer.photons) - 1, -1, -1):
        best, *same = answer.equal(flux)
        text = f"{answer.magnitudes[flux]:.2f} {best}"
        parts.append(f"{text} (as good: {', '.join(same)})" if same else text)
    return "; ".join(parts)


def _ends(answer: LoopAnswer) -> str | None:
    """Name tuned values of the recommended and reference methods that are at the end of their range."""
    flux = answer.at_star
    parts = [
        f"{value} {plain_number(answer.choice(name, flux)[value])} of {name}"
        for name in dict.fromkeys((answer.best.name, *REFERENCES))
        for value in answer.at_end(name, flux)
    ]
    return ", ".join(parts) or None
