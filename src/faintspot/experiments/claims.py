"""The claims of Basden et al. 2015 (arXiv:1503.06043) with their rules and verdicts, and when to use TV."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faintspot.experiments import judges
from faintspot.experiments.arms import NO_TV, SMOOTHING, TV, TV_OVER_NO_TV, label_of
from faintspot.experiments.curves import Curve, Gain, gain_at_error
from faintspot.experiments.judges import LEVEL_PX
from faintspot.experiments.study_curves import (
    AgainstTV,
    Configuration,
    Finding,
    Verdict,
    against_tv,
    study_curves,
)
from faintspot.report.texts import Texts

if TYPE_CHECKING:
    import xarray


BEST_MODE = "best"
FIXED_MODE = "fixed40"


def fixed_mode(dataset: xarray.Dataset) -> str:
    """Return the mode of one k for all arms that is shown: k = 40, or else the largest of the study."""
    fixed = [str(name) for name in dataset["mode"].values if str(name).startswith("fixed")]
    return FIXED_MODE if FIXED_MODE in fixed or not fixed else fixed[-1]


def verdicts(dataset: xarray.Dataset, seed: int = 2015) -> list[Verdict]:
    """Return the verdict on every claim of the paper.

    Parameters
    ----------
    dataset : xarray.Dataset
        A study; cells that are not finished do not count.
    seed : int
        Of the bootstraps, so that the same study always gets the same verdicts.
    """
    modes = [str(name) for name in dataset["mode"].values]
    if not {NO_TV, TV} <= {str(name) for name in dataset["arm"].values}:
        return []
    results = []
    for number, (text, judge) in enumerate(zip(_TEXT["claims"], judges.JUDGES, strict=True), start=1):
        rule = text["rule"].format(level=LEVEL_PX, equal=judges.EQUAL)
        findings = []
        for mode in (BEST_MODE, fixed_mode(dataset)):
            rng = np.random.default_rng([seed, number])
            findings.append(Finding(mode, judge(dataset, mode, rng) if mode in modes else []))
        results.append(Verdict(number, text["claim"], rule, *findings))
    return results


_TEXT = Texts("faintspot.experiments")
_WORTH_IT = 1.1
"""Flux gain from which the cost of denoising is called worth it."""
_MOST_LISTED = 4


@dataclass(frozen=True)
class _Compared:
    """The gain of TV over no denoising and over Gaussian smoothing, for one configuration."""

    configuration: Configuration
    gain: Gain
    over_gaussian: Gain | None


def guidance(dataset: xarray.Dataset, seed: int = 2015) -> list[str]:
    """Return paragraphs that say when a user should use TV.

    Parameters
    ----------
    dataset : xarray.Dataset
        A study with TV and brightest pixels; otherwise the only paragraph says so.
    seed : int
        Of the bootstraps.
    """
    arms = {str(arm) for arm in dataset["arm"].values}
    if not {NO_TV, TV} <= arms:
        return [_TEXT["guidance.no_tv"]]
    rng = np.random.default_rng(seed)
    curves = study_curves(dataset, BEST_MODE)
    best = _compared(curves, rng, SMOOTHING in arms)
    if not best:
        return [_TEXT("guidance.no_gains", level=LEVEL_PX), *_against_baselines(dataset)]
    paragraphs = [_best_k(best), *_where(best)]
    fixed = fixed_mode(dataset)
    if fixed in dataset["mode"].values:
        paragraphs += _fixed_k(best, _compared(study_curves(dataset, fixed), rng, False), fixed)
        paragraphs += _choosing_k(curves, study_curves(dataset, fixed), fixed, rng)
    return [*paragraphs, *_against_gaussian(best), *_against_baselines(dataset), _recommendation(best)]


def _compared(
    curves: dict[Configuration, Curve], rng: np.random.Generator, gaussian: bool
) -> list[_Compared]:
    found = []
    for key, curve in sorted(curves.items()):
        gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV)
        if gain is None or not np.isfinite(gain.log_se):
            continue
        over = gain_at_error(curve, LEVEL_PX, rng, method=TV, reference=SMOOTHING) if gaussian else None
        known = over is not None and np.isfinite(over.log_se)
        found.append(_Compared(key, gain, over if known else None))
    return found


def _best_k(best: list[_Compared]) -> str:
    better = sum(item.gain.low > 1 for item in best)
    worse = sum(item.gain.high < 1 for item in best)
    factors = np.array([item.gain.factor for item in best])
    median = float(np.median(factors))
    return _TEXT(
        "guidance.best_k",
        level=LEVEL_PX,
        better=better,
        all=len(best),
        worse=worse,
        undecided=len(best) - better - worse,
        least=factors.min(),
        most=factors.max(),
        median=median,
        magnitudes=2.5 * np.log10(median),
    )


def _where(best: list[_Compared]) -> list[str]:
    most = sorted(best, key=lambda item: -item.gain.low)
    worth = [item for item in most if item.gain.low > _WORTH_IT]
    costs = [item for item in reversed(most) if item.gain.high < 1]
    found = "worth" if worth else "not_worth"
    paragraphs = [_TEXT(f"guidance.{found}", worth=_WORTH_IT, count=len(worth), listed=_listed(worth))]
    if costs:
        paragraphs.append(_TEXT("guidance.costs", count=len(costs), listed=_listed(costs)))
    return [*paragraphs, *_with_noise(best)]


def _with_noise(best: list[_Compared]) -> list[str]:
    """Describe the gain against read noise, by spot profile, for round Nyquist-sampled spots."""
    lines = []
    for profile in sorted({item.configuration.profile for item in best}):
        gains: dict[float, list[float]] = {}
        for item in best:
            key = item.configuration
            if (key.profile, key.size, key.elongation) == (profile, 1.0, 1.0):
                gains.setdefault(key.read_noise_e, []).append(item.gain.factor)
        if gains:
            values = "; ".join(f"{noise:g} e- {np.median(gains[noise]):.2f}" for noise in sorted(gains))
            lines.append(f"{profile} spots: {values}")
    if not lines:
        return []
    return [_TEXT("guidance.with_noise", profiles=". ".join(lines))]


def _fixed_k(best: list[_Compared], fixed: list[_Compared], mode: str) -> list[str]:
    of_best = {item.configuration: item.gain for item in best}
    pairs = [(of_best[item.configuration], item.gain) for item in fixed if item.configuration in of_best]
    if not pairs:
        return []
    larger = sum(other.low > own.high for own, other in pairs)
    smaller = sum(other.high < own.low for own, other in pairs)
    own, other = (float(np.median([pair[i].factor for pair in pairs])) for i in (0, 1))
    conclusion = _TEXT["guidance.fixed_k_flatters" if larger > smaller else "guidance.fixed_k_does_not"]
    counts = {"pairs": len(pairs), "larger": larger, "smaller": smaller, "own": own, "other": other}
    k = mode.removeprefix("fixed")
    return [_TEXT("guidance.fixed_k", k=k, **counts, conclusion=conclusion)]


def _choosing_k(
    best: dict[Configuration, Curve], fixed: dict[Configuration, Curve], mode: str, rng: np.random.Generator
) -> list[str]:
    """Describe the gain of a good number of pixels kept, without denoising."""
    ratios = []
    for key, curve in best.items():
        if key in fixed:
            error, other = curve.of(NO_TV), fixed[key].of(NO_TV)
            known = np.isfinite(error) & np.isfinite(other) & (other < 0.8 * key.prior_error_px)
            ratios += (other[known] / error[known]).tolist()
    if not ratios:
        return []
    k = mode.removeprefix("fixed")
    median = float(np.median(ratios))
    conclusion = _TEXT("guidance.tune_k" if median > 1.02 else "guidance.k_is_good", k=k)
    return [_TEXT("guidance.choosing_k", k=k, median=median, most=max(ratios), conclusion=conclusion)]


def _against_gaussian(best: list[_Compared]) -> list[str]:
    known = [(item, item.over_gaussian) for item in best if item.over_gaussian is not None]
    if not known:
        return []
    tv, gaussian = sum(over.low > 1 for _, over in known), sum(over.high < 1 for _, over in known)
    median = float(np.median([over.factor for _, over in known]))
    verdict = {1: "tv_is_better", -1: "gaussian_is_better", 0: "neither"}[np.sign(tv - gaussian)]
    counts = {"tv": tv, "all": len(known), "gaussian": gaussian, "median": median}
    return [_TEXT("guidance.gaussian", level=LEVEL_PX, **counts, conclusion=_TEXT[f"guidance.{verdict}"])]


def _against_baselines(dataset: xarray.Dataset) -> list[str]:
    lines = []
    for profile, rows in _by_profile(against_tv(dataset, BEST_MODE)).items():
        ahead = [
            f"{label_of(row.arm)} ({row.smaller} to {row.larger})" for row in rows if row.smaller > row.larger
        ]
        verdict = (
            f"ahead of TV more often than behind: {', '.join(ahead)}"
            if ahead
            else "nothing is ahead of TV more often than behind"
        )
        lines.append(f"{profile} spots ({rows[0].cells} cells): {verdict}")
    if not lines:
        return []
    return [_TEXT("guidance.baselines", lines="; ".join(lines))]


def _recommendation(best: list[_Compared]) -> str:
    use = [
        item
        for item in best
        if item.gain.low > _WORTH_IT and (item.over_gaussian is None or item.over_gaussian.low > 1)
    ]
    worth = sum(item.gain.low > _WORTH_IT for item in best)
    counts = {"worth": _WORTH_IT, "all": len(best)}
    if not worth:
        return _TEXT("guidance.advice_against", **counts)
    if not use:
        return _TEXT("guidance.advice_smoothing", **counts, count=worth)
    where = sorted(use, key=lambda item: -item.gain.low)
    left = len(best) - len(use)
    rest = _TEXT("guidance.rest", count=left) if left else ""
    also = " and beats Gaussian smoothing" if any(item.over_gaussian for item in use) else ""
    listed = _listed(where)
    return _TEXT("guidance.advice_for", **counts, count=len(use), also=also, listed=listed, rest=rest)


def _listed(items: list[_Compared]) -> str:
    shown = [f"{item.configuration.in_words()}: {item.gain.in_words()}" for item in items[:_MOST_LISTED]]
    more = f"; and {len(items) - _MOST_LISTED} more" if len(items) > _MOST_LISTED else ""
    return "; ".join(shown) + more + "."


def _by_profile(rows: list[AgainstTV]) -> dict[str, list[AgainstTV]]:
    found: dict[str, list[AgainstTV]] = {}
    for row in rows:
        found.setdefault(row.profile, []).append(row)
    return found
