"""Verdicts on the claims of Basden et al. 2015 (arXiv:1503.06043) from the results of a study.

All intervals are of 95 %. The two methods are brightest pixels without denoising and TV denoising. Where
nothing is left of a spot every estimator answers about the centre, so that flux gains mean nothing: they are
taken only where R without TV is below INFORMATIVE times that of an estimator that always answers the centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from faintspot.base.report.texts import Texts, with_error, with_interval
from faintspot.experiments.curves import Curve, Gain, gain_at_error, gain_at_flux
from faintspot.experiments.methods import NO_TV, TV, TV_OVER_NO_TV
from faintspot.experiments.study.curves import (
    KEPT_RANGE,
    Case,
    Outcome,
    StudyConditions,
    judged,
    kept_panels,
    measured_profiles,
    names_of,
    spread,
    study_curves,
)
from faintspot.experiments.study.sweep import STANDARD

if TYPE_CHECKING:
    import xarray


_TEXT = Texts("faintspot.experiments")
Curves = Mapping[StudyConditions, Curve]

INFORMATIVE = 0.8
LEVEL_PX = 0.15
"""R at which configurations are compared: below saturation, above the bright end, reached by nearly all."""

_LEVELS_PX = (0.1, 0.15, 0.2, 0.3)
_SIGMAS = 1.96
EQUAL = 0.05  # a change of R of which one would say "independent of"
_FAMILY_FALSE_ALARM = 0.05
_FREE = ("size", "elongation", "pixels", "background_e", "em_gain")


def selected(curves: Curves, **parameters: float | str) -> list[tuple[StudyConditions, Curve]]:
    """Return curves by their parameters; others are size 1, round, 16 pixels, no background or EM."""
    standard = {name: STANDARD[name] for name in _FREE}
    required = {name: value for name, value in (standard | parameters).items() if value != "any"}
    return [
        (key, curve)
        for key, curve in sorted(curves.items())
        if all(getattr(key, name) == value for name, value in required.items())
    ]


def largest_gain(
    configuration: StudyConditions, curve: Curve, rng: np.random.Generator
) -> tuple[float, Gain] | None:
    """Return the flux without TV with the largest gain, by the interval's lower end, and that gain.

    Where TV reaches the error below the lowest flux of the study, its gain is not known.
    """
    limit = INFORMATIVE * configuration.prior_error_px
    gains = []
    for flux, error in zip(curve.flux_e, curve.of(NO_TV), strict=True):
        if np.isfinite(error) and error <= limit:
            gain = gain_at_flux(curve, float(flux), rng, **TV_OVER_NO_TV)
            if gain is not None and gain.is_bounded:
                gains.append((float(flux), gain))
    return max(gains, key=lambda item: item[1].low, default=None)


def thirty_equal_eighty(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Compare TV at 30 e- with none at 80 e-."""
    for key, curve in selected(study_curves(dataset, mode), read_noise_e=0.1):
        with_tv, without = curve.at(30, TV), curve.at(80, NO_TV)
        gain = gain_at_flux(curve, 80, rng, **TV_OVER_NO_TV)
        if with_tv is None or without is None or gain is None:
            continue
        words = {"tv": with_error(with_tv, 4), "plain": with_error(without, 4), "gain": gain.in_words()}
        finding = _TEXT("findings.thirty", **words)
        yield Case(key.in_words(), finding, _reaches(gain, 80 / 30))


def two_to_three(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Look for the largest flux gain of every Nyquist-sampled configuration."""
    for key, curve in selected(study_curves(dataset, mode)):
        largest = largest_gain(key, curve, rng)
        if largest is None:
            continue
        flux, gain = largest
        finding = f"largest gain {gain.in_words()}, {_in_magnitudes(gain)}, at {flux:g} e-"
        yield Case(key.in_words(), finding, _reaches(gain, 2.0))


def small_spots(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Compare the gains of spots of different size."""
    curves = selected(study_curves(dataset, mode), size="any")
    for group in _grouped(curves, "size"):
        gains = _level_gains(group, rng)
        if len(gains) < 2:
            continue
        (_, smallest), *larger = gains
        differences = [_difference(smallest, gain) for _, gain in larger]
        words = "; ".join(f"size {key.size:g} {gain.in_words()}" for key, gain in gains)
        finding = _TEXT("findings.gain_level", level=LEVEL_PX, gains=words)
        holds = all(difference > _SIGMAS * error for difference, error in differences)
        fails = any(difference < -_SIGMAS * error for difference, error in differences)
        yield Case(gains[0][0].in_words(without="size"), finding, judged(holds, not fails))


def independent_of_pixels(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Compare R in the largest and in the smallest window."""
    curves = selected(study_curves(dataset, mode), read_noise_e=0.1, pixels="any")
    for group in _grouped(curves, "pixels"):
        (small_key, small), (large_key, large) = group[0], group[-1]
        for flux in np.intersect1d(small.flux_e, large.flux_e):
            changes = [_log_change(small, large, float(flux), method) for method in (TV, NO_TV)]
            if any(change is None for change in changes):
                continue
            (tv, tv_error), (plain, plain_error) = (change for change in changes if change is not None)
            words = _in_both((tv, tv_error), (plain, plain_error))
            finding = f"R at {large_key.pixels} px / R at {small_key.pixels} px: {words}"
            within = abs(tv) - _SIGMAS * tv_error <= np.log1p(EQUAL)
            less = abs(plain) - abs(tv) > _SIGMAS * np.hypot(tv_error, plain_error)
            condition = f"{flux:g} e-, {large_key.in_words(without='pixels')}"
            yield Case(condition, finding, judged(bool(within), bool(less)))


def _in_both(tv: tuple[float, float], plain: tuple[float, float]) -> str:
    """Format two ratios of R from their logarithms and standard errors."""
    with_tv, without = (f"{np.exp(log):.3f} ± {np.exp(log) * error:.3f}" for log, error in (tv, plain))
    return f"{with_tv} with TV, {without} without"


def less_dependence_on_k(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Compare how much R changes with k."""
    is_fixed = mode.startswith("fixed")
    modes = [name for name in names_of(dataset, "mode") if is_fixed and name.startswith("fixed")]
    names = ", ".join(name.removeprefix("fixed") for name in modes) or f"{KEPT_RANGE[0]} to {KEPT_RANGE[1]}"
    for panel in (panel for profile in measured_profiles(dataset) for panel in kept_panels(dataset, profile)):
        for label, cell in panel.cells:
            tv, plain = (spread(dataset, cell, method, modes) for method in (TV, NO_TV))
            if tv is not None and plain is not None:
                finding = f"largest R / smallest R for k = {names}: {_in_both(tv, plain)}"
                less, limit = plain[0] - tv[0], _SIGMAS * np.hypot(tv[1], plain[1])
                yield Case(f"{label}; {panel.title}", finding, judged(less > limit, abs(less) <= limit))


def elongated(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Follow the gain of elongated spots with read noise."""
    curves = [
        item
        for item in selected(study_curves(dataset, mode), elongation="any")
        if item[0].elongation > 1 and item[0].read_noise_e > 0
    ]
    for group in _grouped(curves, "read_noise_e"):
        gains = _level_gains(group, rng)
        clear = [(key, gain) for key, gain in gains if np.isfinite(gain.log_se) and gain.log_se > 0]
        if len(clear) < 2:
            continue
        slope, error = _slope_with_noise(clear)
        saved = [100 * (1 - 1 / np.array([g.factor, g.low, g.high])) for k, g in clear if k.read_noise_e >= 3]
        most = max(saved, key=lambda item: item[1], default=None)
        gains_words = "; ".join(f"{key.read_noise_e:g} e- {gain.in_words()}" for key, gain in clear)
        finding = _TEXT("findings.elongated", slope=slope, error=error, level=LEVEL_PX, gains=gains_words)
        reached = most is not None and most[2] >= 25
        if most is not None:
            finding += f"; most flux saved at 3 e- or more: {most[0]:.0f} % ({most[1]:.0f} to {most[2]:.0f})"
        grows = slope > _SIGMAS * error
        yield Case(
            clear[0][0].in_words(without="read_noise_e"), finding, judged(grows and reached, grows or reached)
        )


def one_magnitude(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Look for the largest gain at 16 e-."""
    for key, curve in selected(study_curves(dataset, mode), read_noise_e=16.0, size="any"):
        gains = [(level, gain_at_error(curve, level, rng, **TV_OVER_NO_TV)) for level in _LEVELS_PX]
        bounded = [(level, gain) for level, gain in gains if gain is not None and gain.is_bounded]
        if not bounded:
            continue
        level, gain = max(bounded, key=lambda item: item[1].low)
        finding = f"most at R = {level:g} px: {_in_magnitudes(gain)}"
        yield Case(key.in_words(), finding, _reaches(gain, 10**0.4))


def never_worse(dataset: xarray.Dataset, mode: str, rng: np.random.Generator) -> Iterator[Case]:
    """Compare R in every cell."""
    from scipy.special import ndtri

    curves = study_curves(dataset, mode)
    total = sum(int(np.isfinite(curve.difference(TV, NO_TV)[0]).sum()) for curve in curves.values())
    limit = -float(ndtri(_FAMILY_FALSE_ALARM / max(total, 1)))
    for profile in measured_profiles(dataset):
        changes: list[tuple[float, float, str]] = []
        for key, curve in selected(curves, profile=profile, **dict.fromkeys(_FREE, "any")):
            difference, error = curve.difference(TV, NO_TV)
            plain = curve.of(NO_TV)
            changes += [
                (d / p, e / p, f"{flux:g} e-, {key.in_words()}")
                for d, e, p, flux in zip(difference, error, plain, curve.flux_e, strict=True)
                if np.isfinite(d)
            ]
        if not changes:
            continue
        better = sum(change > limit * error for change, error, _ in changes)
        worse = sum(change < -limit * error for change, error, _ in changes)
        mean = float(np.mean([change for change, _, _ in changes]))
        mean_error = float(np.sqrt(np.sum([error**2 for _, error, _ in changes])) / len(changes))
        least, least_error, condition = min(changes)
        finding = _TEXT(
            "findings.never_worse",
            cells=len(changes),
            better=better,
            worse=worse,
            same=len(changes) - better - worse,
            mean=-100 * mean,
            mean_error=100 * mean_error,
            least=-100 * least,
            least_error=100 * least_error,
            where=condition,
        )
        yield Case(f"{profile} spots", finding, judged(worse == 0, better > worse))


JUDGES: tuple[Callable[[xarray.Dataset, str, np.random.Generator], Iterator[Case]], ...] = (
    thirty_equal_eighty,
    two_to_three,
    small_spots,
    independent_of_pixels,
    less_dependence_on_k,
    elongated,
    one_magnitude,
    never_worse,
)
"""By claim, in the order of the paper's."""


def _reaches(gain: Gain, claimed: float) -> Outcome:
    """Return whether the interval reaches a claimed factor, or half of it in magnitudes."""
    return judged(gain.high >= claimed, gain.high >= np.sqrt(claimed))


def _in_magnitudes(gain: Gain) -> str:
    return f"{with_interval(gain.in_magnitudes, 2)} mag"


def _difference(first: Gain, second: Gain) -> tuple[float, float]:
    """Return ln(first) - ln(second) and its standard error; 0 and inf where one is not known."""
    error = float(np.hypot(first.log_se, second.log_se))
    if not np.isfinite(error) or not 0 < first.factor < np.inf or not 0 < second.factor < np.inf:
        return 0.0, float("inf")
    return float(np.log(first.factor / second.factor)), error


def _log_change(small: Curve, large: Curve, flux_e: float, method: str) -> tuple[float, float] | None:
    first, second = small.at(flux_e, method), large.at(flux_e, method)
    if first is None or second is None:
        return None
    errors = (value.standard_error / value.value for value in (first, second))
    return math.log(second.value / first.value), math.hypot(*errors)


def _slope_with_noise(gains: list[tuple[StudyConditions, Gain]]) -> tuple[float, float]:
    """Return the weighted least-squares slope of ln(gain) on log10(read noise), with its standard error."""
    x = np.log10([key.read_noise_e for key, _ in gains])
    y = np.log([gain.factor for _, gain in gains])
    weights = 1 / np.array([gain.log_se for _, gain in gains])
    line, covariance = np.polyfit(x, y, 1, w=weights, cov="unscaled")
    return float(line[0]), math.sqrt(covariance[0, 0])


def _level_gains(
    group: Iterable[tuple[StudyConditions, Curve]], rng: np.random.Generator
) -> list[tuple[StudyConditions, Gain]]:
    gains = [(key, gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV)) for key, curve in group]
    return [(key, gain) for key, gain in gains if gain is not None and gain.is_bounded]


def _grouped(
    curves: Iterable[tuple[StudyConditions, Curve]], varied: str
) -> list[list[tuple[StudyConditions, Curve]]]:
    """Return groups of at least two curves that differ in one parameter only, by increasing value of it."""
    groups: dict[str, list[tuple[StudyConditions, Curve]]] = {}
    for key, curve in curves:
        groups.setdefault(key.in_words(without=varied), []).append((key, curve))
    return [
        sorted(group, key=lambda item: float(getattr(item[0], varied)))
        for group in groups.values()
        if len(group) > 1
    ]
