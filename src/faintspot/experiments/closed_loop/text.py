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
    lines = [f"Recommended: {best.name} ({choice_in_words(answer.choice(best.name, flux))})"]
    strehl = with_error(answer.strehl(best.name, flux), smallest=_SMALLEST_ERROR)
    wavelength = 1e6 * answer.question.configuration.science.wavelength_m
    lines.append(_TEXT("loop_answer.expected", strehl=strehl, wavelength_um=wavelength))
    if same:
        chosen = "the baseline" if best.name == BASELINE else "what is simplest"
        lines.append(_TEXT("loop_answer.no_winner", same=", ".join(same), taken=chosen))
    lines += [
        f"against {reference}: {difference_in_words(answer, best.name, reference)}"
        for reference in REFERENCES
        if reference != best.name
    ]
    lines += _along_the_magnitudes(answer)
    lines += [f"{_ends(answer)}"] if _ends(answer) else []
    return lines


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
    origin = "given" if answer.question.radius_arcsec is not None else "the isoplanatic angle of the layers"
    best, parts = answer.best.name, []
    for place in PLACES:
        coverage = answer.coverage(best, place)
        assert coverage is not None
        parts.append(f"{plain_number(100 * coverage.model_error, 2)} ({place})")
    percent = 100 * MODEL_ERROR
    return [
        _TEXT("loop_answer.sky", level=answer.level, radius=radius, given=origin),
        _TEXT("loop_answer.sky_errors", percent=percent, best=best, parts=", ".join(parts)),
    ]


def foundations(answer: LoopAnswer) -> list[str]:
    """Describe what the answer is based on."""
    step = magnitudes_apart(answer.photons.tolist())
    measured = ", ".join(f"{magnitude:.2f}" for magnitude in answer.magnitudes[::-1])
    photons = ", ".join(plain_number(flux) for flux in answer.photons[::-1])
    counts = {"count": answer.realisations, "frames": answer.scored_frames}
    lines = [
        _TEXT("loop_answer.measured", magnitudes=measured, photons=photons, step=step),
        _TEXT("loop_answer.realisations", **counts),
        _TEXT["loop_answer.paired"],
        _TEXT["loop_answer.limits"],
    ]
    return lines + [f"{name} was not tried: {reason}" for name, reason in answer.left_out.items()]


def _along_the_magnitudes(answer: LoopAnswer) -> list[str]:
    """Describe the recommendation for other stars."""
    parts = []
    for flux in range(len(answer.photons) - 1, -1, -1):
        best, *same = answer.equal(flux)
        text = f"{answer.magnitudes[flux]:.2f} {best}"
        parts.append(f"{text} (as good: {', '.join(same)})" if same else text)
    return [f"by magnitude: {'; '.join(parts)}"]


def _ends(answer: LoopAnswer) -> str:
    """Name tuned values of the recommended and reference methods that are at the end of their range."""
    flux = answer.at_star
    parts = []
    for name in dict.fromkeys((answer.best.name, *REFERENCES)):
        choice = answer.choice(name, flux)
        parts += [f"{value} {plain_number(choice[value])} of {name}" for value in answer.at_end(name, flux)]
    if not parts:
        return ""
    return _TEXT("loop_answer.at_end", parts=", ".join(parts))
