"""The claims of Basden et al. 2015 (arXiv:1503.06043) with their rules and verdicts, and when to use TV."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faintspot.experiments import judges
from faintspot.experiments.arms import NO_TV, SMOOTHING, TV, TV_OVER_NO_TV, label_of
from faintspot.experiments.curves import Curve, Gain, gain_at_error
from faintspot.experiments.judges import LEVEL_PX
from faintspot.experiments.study_curves import (
    AgainstTV,
    Case,
    Configuration,
    Finding,
    Verdict,
    against_tv,
    study_curves,
)

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
    for number, (claim, rule, judge) in enumerate(_CLAIMS, start=1):
        findings = []
        for mode in (BEST_MODE, fixed_mode(dataset)):
            rng = np.random.default_rng([seed, number])
            findings.append(Finding(mode, judge(dataset, mode, rng) if mode in modes else []))
        results.append(Verdict(number, claim, rule, *findings))
    return results


_Judge = Callable[["xarray.Dataset", str, np.random.Generator], list[Case]]
_INTERVAL = "all intervals 95 %"
_CLAIMS: tuple[tuple[str, str, _Judge], ...] = (
    (
        "30 photons with TV equal 80 without (0.1 e- read noise)",
        f"Holds where the interval of the flux gain at 80 e- ({_INTERVAL}) reaches 80 / 30 = 2.67; in part "
        "where it reaches half of that in magnitudes, a factor 1.63.",
        judges.thirty_equal_eighty,
    ),
    (
        "A factor 2 to 3 less flux, up to one magnitude",
        "Of each configuration (Nyquist-sampled, 16 × 16 px) the flux with the largest gain by the "
        "interval's lower end. Holds where the interval reaches 2; in part where it reaches half of "
        "that in magnitudes, a factor 1.41.",
        judges.two_to_three,
    ),
    (
        "Small spots gain most",
        f"Flux gains at R = {judges.LEVEL_PX} px. Holds where the smallest spot's gain is above every other "
        "size's by 1.96 standard errors; in part where not decided; not where another size gains more.",
        judges.small_spots,
    ),
    (
        "R with TV does not depend on the sub-aperture's size",
        f"R of the largest window over R of the smallest. Holds where the interval reaches within "
        f"{judges.EQUAL:.0%} of 1; in part where R changes, but by less than without TV.",
        judges.independent_of_pixels,
    ),
    (
        "R depends less on the number of brightest pixels kept",
        "Best k: largest over smallest R as k runs, at the strength chosen for best k. Fixed k: the same "
        "over the fixed k of the study, the strength chosen for each. Holds where TV's is smaller by 1.96 "
        "standard errors; in part where not decided.",
        judges.less_dependence_on_k,
    ),
    (
        "Elongated spots: the gain grows with read noise, up to 25 % less flux above 3 e-",
        f"Flux gains at R = {judges.LEVEL_PX} px. Holds where ln(gain) grows with log(read noise) by 1.96 "
        "standard errors and the interval of the largest saving at 3 e- or more reaches 25 %; in part for "
        "one of the two.",
        judges.elongated,
    ),
    (
        "One magnitude at 16 e- read noise",
        "The largest gain, by the interval's lower end, at R = 0.1, 0.15, 0.2 or 0.3 px. Holds where its "
        "interval reaches 1 mag; in part where it reaches 0.5 mag.",
        judges.one_magnitude,
    ),
    (
        "Never worse on average",
        "Paired differences of R in all cells, with a false-alarm rate of 5 % for all of them together "
        "(Bonferroni). Holds where no cell is worse; in part where more cells are better than worse.",
        judges.never_worse,
    ),
)


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
        return ["This study does not compare TV with brightest pixels alone, so it gives no advice on TV."]
    rng = np.random.default_rng(seed)
    curves = study_curves(dataset, BEST_MODE)
    best = _compared(curves, rng, SMOOTHING in arms)
    if not best:
        return [
            f"No configuration of this study has curves that reach R = {LEVEL_PX} px, so flux gains cannot "
            "be given. The figures show what there is.",
            *_against_baselines(dataset),
        ]
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
    better = [item for item in best if item.gain.low > 1]
    worse = [item for item in best if item.gain.high < 1]
    factors = np.array([item.gain.factor for item in best])
    median = float(np.median(factors))
    start = (
        f"With the best k in every arm, and compared at R = {LEVEL_PX} px, TV needs less flux than "
        f"brightest pixels alone in {len(better)} of {len(best)} configurations, more in {len(worse)}; in "
        f"{len(best) - len(better) - len(worse)} the 95 % interval contains 1. "
    )
    middle = f"The flux gain is {factors.min():.2f} to {factors.max():.2f}, with a median of {median:.2f} ("
    return start + middle + f"{2.5 * np.log10(median):+.2f} mag)."


def _where(best: list[_Compared]) -> list[str]:
    most = sorted(best, key=lambda item: -item.gain.low)
    worth = [item for item in most if item.gain.low > _WORTH_IT]
    costs = [item for item in reversed(most) if item.gain.high < 1]
    paragraphs = []
    if worth:
        paragraphs.append(
            f"It gains more than {_WORTH_IT:g} (interval above it) in {len(worth)} configurations, most in: "
            + _listed(worth)
        )
    else:
        paragraphs.append(f"In no configuration is the gain above {_WORTH_IT:g} beyond its error.")
    if costs:
        paragraphs.append(f"It loses flux in {len(costs)}, most in: {_listed(costs)}")
    return [*paragraphs, *_with_noise(best)]


def _with_noise(best: list[_Compared]) -> list[str]:
    """Say how the gain goes with read noise, by spot profile, for round Nyquist-sampled spots."""
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
    return [f"Median gain of round spots of size 1 by read noise. {'. '.join(lines)}."]


def _fixed_k(best: list[_Compared], fixed: list[_Compared], mode: str) -> list[str]:
    of_best = {item.configuration: item.gain for item in best}
    pairs = [(of_best[item.configuration], item.gain) for item in fixed if item.configuration in of_best]
    if not pairs:
        return []
    larger = sum(other.low > own.high for own, other in pairs)
    smaller = sum(other.high < own.low for own, other in pairs)
    own, other = (float(np.median([pair[i].factor for pair in pairs])) for i in (0, 1))
    k = mode.removeprefix("fixed")
    text = (
        f"With k fixed at {k} in both arms the median gain is {other:.2f} instead of {own:.2f} in the "
        f"{len(pairs)} configurations that have both: larger in {larger}, smaller in {smaller}, beyond both "
        "intervals. "
    )
    if larger > smaller:
        return [
            f"{text}Part of what TV seems to save there is what the k of the other arm costs: a system whose "
            "k cannot be tuned gains more from TV than one whose k is."
        ]
    return [f"{text}So in this study a fixed k does not make TV look better than it is."]


def _choosing_k(
    best: dict[Configuration, Curve], fixed: dict[Configuration, Curve], mode: str, rng: np.random.Generator
) -> list[str]:
    """Say what a good k alone is worth, without denoising."""
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
    start = f"Without any denoising, the best k in place of k = {k} divides R by {median:.2f} in the median "
    middle = f"cell and by up to {max(ratios):.2f}"
    if median > 1.02:
        return [f"{start}{middle}: tune k before anything else."]
    return [f"{start}{middle}: k = {k} is nearly as good as the best in most cells."]


def _against_gaussian(best: list[_Compared]) -> list[str]:
    known = [(item, item.over_gaussian) for item in best if item.over_gaussian is not None]
    if not known:
        return []
    tv = [item for item, over in known if over.low > 1]
    gaussian = [item for item, over in known if over.high < 1]
    median = float(np.median([over.factor for _, over in known]))
    text = (
        f"Against linear Gaussian smoothing of the best width with the best k, at R = {LEVEL_PX} px, TV "
        f"needs less flux in {len(tv)} of {len(known)} configurations and more in {len(gaussian)}; median "
        f"flux gain of TV over it {median:.2f}. "
    )
    if len(tv) > len(gaussian):
        return [text + "TV is the better of the two more often."]
    if len(gaussian) > len(tv):
        return [
            text + "Gaussian smoothing, which is simpler and faster, is the better of the two more often."
        ]
    return [text + "Neither is the better more often; Gaussian smoothing is simpler and faster."]


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
    return [f"Cell by cell, at all signals, with the best k in every arm: {'; '.join(lines)}."]


def _recommendation(best: list[_Compared]) -> str:
    use = [
        item
        for item in best
        if item.gain.low > _WORTH_IT and (item.over_gaussian is None or item.over_gaussian.low > 1)
    ]
    worth = sum(item.gain.low > _WORTH_IT for item in best)
    if not worth:
        return (
            "Advice: do not use TV on the strength of this study. In no configuration does it save "
            f"more than a factor {_WORTH_IT:g} of flux with a tuned k."
        )
    if not use:
        return (
            f"Advice: tune k first, and smooth with a Gaussian before you think of TV. TV saves more than a "
            f"factor {_WORTH_IT:g} of flux with a tuned k in {worth} of {len(best)} configurations, but in "
            "none of them is it ahead of Gaussian smoothing: use it only where smoothing is not at hand."
        )
    where = sorted(use, key=lambda item: -item.gain.low)
    rest = len(best) - len(use)
    tail = (
        f" In the other {rest} configurations tune k first, and try Gaussian smoothing before TV."
        if rest
        else ""
    )
    also = " and beats Gaussian smoothing" if any(item.over_gaussian for item in use) else ""
    return (
        f"Advice: use TV in the {len(use)} of {len(best)} configurations in which it saves more than a "
        f"factor {_WORTH_IT:g} of flux with a tuned k{also}: {_listed(where)}{tail}"
    )


def _listed(items: list[_Compared]) -> str:
    shown = [f"{item.configuration.in_words()}: {item.gain.in_words()}" for item in items[:_MOST_LISTED]]
    more = f"; and {len(items) - _MOST_LISTED} more" if len(items) > _MOST_LISTED else ""
    return "; ".join(shown) + more + "."


def _by_profile(rows: list[AgainstTV]) -> dict[str, list[AgainstTV]]:
    found: dict[str, list[AgainstTV]] = {}
    for row in rows:
        found.setdefault(row.profile, []).append(row)
    return found
