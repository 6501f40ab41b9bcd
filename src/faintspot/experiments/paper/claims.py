"""The claims of Basden et al. 2015 (arXiv:1503.06043) with their rules and verdicts, and when to use TV."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faintspot.base.report.texts import Texts
from faintspot.base.statistics import magnitudes
from faintspot.experiments.curves import Gain, gain_at_error
from faintspot.experiments.methods import NO_TV, SMOOTHING, TV, TV_OVER_NO_TV
from faintspot.experiments.paper import judges
from faintspot.experiments.paper.judges import LEVEL_PX, Curves
from faintspot.experiments.study.curves import Judgement, StudyConditions, Verdict, study_curves
from faintspot.experiments.study.specification import BEST

if TYPE_CHECKING:
    import xarray


FIXED_MODE = "fixed40"


def fixed_mode(dataset: xarray.Dataset) -> str:
    """Return the mode of one k for all methods that is shown: k = 40, or else the largest of the study."""
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
    if not {NO_TV, TV} <= {str(name) for name in dataset["estimator"].values}:
        return []
    results = []
    for number, (text, judge) in enumerate(zip(_TEXT["claims"], judges.JUDGES, strict=True), start=1):
        rule = text["rule"].format(level=LEVEL_PX, equal=judges.EQUAL)
        findings = []
        for mode in (BEST, fixed_mode(dataset)):
            rng = np.random.default_rng([seed, number])
            findings.append(Judgement(mode, judge(dataset, mode, rng) if mode in modes else []))
        results.append(Verdict(number, text["claim"], rule, *findings))
    return results


_TEXT = Texts("faintspot.experiments")
_WORTH_IT = 1.1
"""Flux gain from which the cost of denoising is called worth it."""
_MOST_LISTED = 4


@dataclass(frozen=True)
class _Compared:
    """The gain of TV over no denoising and over Gaussian smoothing, for one configuration."""

    configuration: StudyConditions
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
    methods = {str(method) for method in dataset["estimator"].values}
    if not {NO_TV, TV} <= methods:
        return [_TEXT["guidance.no_tv"]]
    rng = np.random.default_rng(seed)
    curves = study_curves(dataset, BEST)
    best = _compared(curves, rng, SMOOTHING in methods)
    if not best:
        return [_TEXT("guidance.no_gains", level=LEVEL_PX)]
    paragraphs = [_flux_gains("brightest pixels alone", [item.gain for item in best])]
    over_gaussian = [item.over_gaussian for item in best if item.over_gaussian is not None]
    if over_gaussian:
        paragraphs.append(_flux_gains("Gaussian smoothing of the best width", over_gaussian))
    fixed = fixed_mode(dataset)
    if fixed in dataset["mode"].values:
        paragraphs += _choosing_k(curves, study_curves(dataset, fixed), fixed)
    return [*paragraphs, _recommendation(best)]


def _compared(curves: Curves, rng: np.random.Generator, gaussian: bool) -> list[_Compared]:
    compared = []
    for key, curve in sorted(curves.items()):
        gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV)
        if gain is None or not np.isfinite(gain.log_se):
            continue
        gain_over = gain_at_error(curve, LEVEL_PX, rng, method=TV, reference=SMOOTHING) if gaussian else None
        is_known = gain_over is not None and np.isfinite(gain_over.log_se)
        compared.append(_Compared(key, gain, gain_over if is_known else None))
    return compared


def _flux_gains(reference: str, gains: list[Gain]) -> str:
    """Return in how many configurations TV needs less flux than a reference, and the median gain."""
    better, worse = sum(gain.low > 1 for gain in gains), sum(gain.high < 1 for gain in gains)
    factors = np.array([gain.factor for gain in gains])
    median = float(np.median(factors))
    counts = {"better": better, "worse": worse, "all": len(gains), "undecided": len(gains) - better - worse}
    values = {
        "least": factors.min(),
        "most": factors.max(),
        "median": median,
        "magnitudes": magnitudes(median),
    }
    return _TEXT("guidance.flux_gains", level=LEVEL_PX, reference=reference, **counts, **values)


def _choosing_k(best: Curves, fixed: Curves, mode: str) -> list[str]:
    """Describe the gain of a good number of pixels kept, without denoising."""
    ratios = []
    for key, curve in best.items():
        if key in fixed:
            error, fixed_error = curve.of(NO_TV), fixed[key].of(NO_TV)
            usable = np.isfinite(error) & np.isfinite(fixed_error) & (fixed_error < 0.8 * key.prior_error_px)
            ratios += (fixed_error[usable] / error[usable]).tolist()
    if not ratios:
        return []
    k = mode.removeprefix("fixed")
    return [_TEXT("guidance.choosing_k", k=k, median=np.median(ratios), most=max(ratios))]


def _recommendation(best: list[_Compared]) -> str:
    worth = [item for item in best if item.gain.low > _WORTH_IT]
    use = [item for item in worth if item.over_gaussian is None or item.over_gaussian.low > 1]
    counts = {"worth": _WORTH_IT, "all": len(best)}
    if not use:
        advice = _TEXT["guidance.advice_smoothing" if worth else "guidance.advice_against"]
        return str(advice.format(**counts, count=len(worth)))
    use.sort(key=lambda item: -item.gain.low)
    listed = [f"{item.configuration.in_words()}: {item.gain.in_words()}" for item in use[:_MOST_LISTED]]
    if len(use) > _MOST_LISTED:
        listed.append(f"and {len(use) - _MOST_LISTED} more")
    return _TEXT("guidance.advice_for", **counts, count=len(use), listed="; ".join(listed))
