"""Table 1 of Basden et al. 2015 beside a night of the same protocol, and how much its differences prove."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.analysis import differences
from faintspot.experiments.night.protocol import BEST_STRENGTHS, TV, Night, NightPlan

PAPER_MEANS = np.array(
    [[0.184, 0.188, 0.200], [0.203, 0.205, 0.214], [0.209, 0.214, 0.220], [0.196, 0.200, 0.206]]
)
"""Mean Strehl ratio of each set: without TV, with all strengths, and with `BEST_STRENGTHS`."""
PAPER_SCATTERS = np.array(
    [[0.001, 0.018, 0.016], [0.012, 0.013, 0.020], [0.015, 0.011, 0.004], [0.016, 0.018, 0.012]]
)
"""Standard deviation of the exposures of each set, as `PAPER_MEANS`."""
PAPER_CORRELATION = 0.38
"""Correlation of Strehl ratio and r0 of the exposures with TV."""
_RANGES = np.arange(0.1, 1.55, 0.1)  # lower ends of other ranges as wide as the paper's
_NIGHTS, _SEED = 1000, 2015


@dataclass(frozen=True)
class PaperColumn:
    """Differences of one column of Table 1 from the exposures without TV, set by set, and in the mean."""

    paper: tuple[Estimate, ...]
    ours: tuple[Estimate, ...]
    paper_mean: Estimate
    our_mean: Estimate
    chi_square: float
    """Chi-square of the paper's differences against ours, over the sets."""
    probability: float
    """Probability of such a chi-square or more where both measure the same."""
    chance: float
    """Probability of a mean difference like the paper's or larger where TV makes no difference."""
    paired: Estimate | None
    """Our difference in the same turbulence; None where that is not known."""

    @property
    def agrees(self) -> str:
        """Whether the two agree, in words."""
        return "agree" if self.probability > 0.05 else "do not agree"

    @property
    def above_paired(self) -> float | None:
        """Standard errors by which the paper's mean difference is above ours in the same turbulence."""
        if self.paired is None:
            return None
        error = math.hypot(self.paper_mean.standard_error, self.paired.standard_error)
        return (self.paper_mean.value - self.paired.value) / error


@dataclass(frozen=True)
class PaperComparison:
    """A night beside the paper: all strengths, and `BEST_STRENGTHS`."""

    every: PaperColumn
    best: PaperColumn
    means: Floats
    """Mean values of the night, in the order of `PAPER_MEANS`."""
    chance_of_any: float
    """Probability that some range as wide as `BEST_STRENGTHS` shows the paper's difference by chance."""


def set_columns(night: Night) -> list[list[NDArray[np.bool_]]]:
    """Return the blocks of each set, of each column of Table 1; a strength of 0 changes nothing."""
    columns = night.is_reference, night.strength > 0, night.strengths_within(*BEST_STRENGTHS)
    return [[rows & column & np.isfinite(night.strehl) for column in columns] for rows in night.sets]


def paper_exposures() -> NDArray[np.int64]:
    """Return the number of exposures of each set and column of the paper's protocol, (sets, 3)."""
    plan, (low, high) = NightPlan(), BEST_STRENGTHS
    counts = []
    for number, repeats in enumerate(plan.repeats):
        strengths = np.array([strength for name, strength in plan.entries(number) if name == TV])
        best = (strengths >= low) & (strengths <= high)
        counts.append([repeats, repeats * int((strengths > 0).sum()), repeats * int(best.sum())])
    return np.array(counts)


def set_differences(means: Floats, scatters: Floats, counts: NDArray[np.int64]) -> list[list[Estimate]]:
    """Return the differences of the second and third column from the first, set by set.

    Standard errors follow from the scatter of a column over all sets: two exposures show none of their own.

    Parameters
    ----------
    means, scatters : (sets, 3) array
    counts : (sets, 3) array of int
        Exposures.
    """
    free = np.maximum(counts - 1, 0)
    pooled = np.sqrt((free * np.nan_to_num(scatters) ** 2).sum(axis=0) / free.sum(axis=0))
    errors = pooled / np.sqrt(counts)
    return [
        [
            Estimate(mean[column] - mean[0], math.hypot(error[column], error[0]))
            for mean, error in zip(means, errors, strict=True)
        ]
        for column in (1, 2)
    ]


def agreement(one: Sequence[Estimate], other: Sequence[Estimate]) -> tuple[float, float]:
    """Return chi-square of two series of estimates, and the probability of as much or more by chance."""
    from scipy.special import chdtrc

    square = sum(
        (a.value - b.value) ** 2 / (a.standard_error**2 + b.standard_error**2)
        for a, b in zip(one, other, strict=True)
    )
    return float(square), float(chdtrc(len(one), square))


def compare_with_paper(night: Night) -> PaperComparison | None:
    """Return a night beside the paper's Table 1; None where it has other sets or a column is empty."""
    columns = set_columns(night)
    counts = np.array([[int(rows.sum()) for rows in each] for each in columns])
    if counts.shape != PAPER_MEANS.shape or counts.min() < 1 or np.any(counts.max(axis=0) < 2):
        return None
    values = [[night.strehl[rows] for rows in each] for each in columns]
    means = np.array([[part.mean() for part in each] for each in values])
    scatters = np.array([[part.std(ddof=1) if len(part) > 1 else 0.0 for part in each] for each in values])
    ours = set_differences(means, scatters, counts)
    papers = set_differences(PAPER_MEANS, PAPER_SCATTERS, paper_exposures())
    chances = chances_without_difference(night, [_mean(each).value for each in papers])
    paired = [each.paired for each in differences(night)[:2]]  # of the same groups
    every, best = (
        PaperColumn(tuple(paper), tuple(our), _mean(paper), _mean(our), *agreement(paper, our), chance, true)
        for paper, our, chance, true in zip(papers, ours, chances[:2], paired, strict=True)
    )
    return PaperComparison(every, best, means, chances[2])


def _mean(parts: Sequence[Estimate]) -> Estimate:
    """Return the mean of independent estimates."""
    error = math.sqrt(sum(part.standard_error**2 for part in parts)) / len(parts)
    return Estimate(float(np.mean([part.value for part in parts])), error)


def chances_without_difference(night: Night, excesses: Sequence[float]) -> tuple[float, float, float]:
    """Return how often nights without any difference show one, from synthetic nights of the same protocol.

    Each has the night's Strehl ratio as a parabola of the logarithm of r0, with the night's drift of r0 begun
    at a random time, and the night's scatter about it, resampled. Exposures of a set scatter as much as the
    paper's, at least as much as the night's about the drift; the drift's share of the variance is at most the
    square of the paper's correlation with r0.

    Parameters
    ----------
    night : Night
    excesses : sequence of two floats
        Differences of all strengths and of `BEST_STRENGTHS`, in the mean of the sets.

    Returns
    -------
    tuple of three floats
        Share of nights with these excesses or larger ones: of all strengths, of `BEST_STRENGTHS`, and of
        whichever range as wide as `BEST_STRENGTHS` has the largest.
    """
    strehl = _synthetic_strehl(night, _NIGHTS, np.random.default_rng(_SEED))

    def excess(chosen: NDArray[np.bool_]) -> Floats:
        """Return the mean difference of the sets that have such blocks, (nights,)."""
        pairs = [(part & chosen, part & night.is_reference) for part in night.sets]
        of_sets = [
            strehl[:, some].mean(axis=1) - strehl[:, others].mean(axis=1)
            for some, others in pairs
            if some.any() and others.any()
        ]
        return np.asarray(np.mean(of_sets, axis=0))

    low, high = BEST_STRENGTHS
    best = excess(night.strengths_within(low, high))
    ranges = [night.strengths_within(end, end + high - low + 1e-9) for end in _RANGES]
    largest = np.max([best, *(excess(rows) for rows in ranges if rows.any())], axis=0)
    every = excess(night.strength > 0)
    shares = every >= excesses[0], best >= excesses[1], largest >= excesses[1]
    return float(shares[0].mean()), float(shares[1].mean()), float(shares[2].mean())


def _synthetic_strehl(night: Night, nights: int, rng: np.random.Generator) -> Floats:
    """Return Strehl ratios of nights without differences, from any mean, (nights, B)."""
    rows, time = np.isfinite(night.strehl), night.middle_s - night.middle_s[0]
    r0_m = np.where(np.isfinite(night.true_r0_m), night.true_r0_m, night.r0_m)
    known = rows & np.isfinite(r0_m)
    drift = np.zeros_like(time)
    if known.any():
        drift = np.interp(time, time[known], np.log(r0_m[known]))
        drift -= drift.mean()
    methods = (night.method[:, None] == np.unique(night.method[rows])).astype(np.float64)
    design = np.column_stack([methods, drift, drift**2])[rows]
    fit, _, rank, _ = np.linalg.lstsq(design, night.strehl[rows], rcond=None)
    residual = night.strehl[rows] - design @ fit
    variance = float(residual @ residual) / max(1, len(residual) - rank)
    span = time[-1] + np.median(np.diff(time))
    away = np.interp((time + span * rng.random((nights, 1))) % span, time, drift)
    strehl: Floats = away * fit[-2] + away**2 * fit[-1]
    of_drift = float(np.mean([strehl[:, part].var(axis=1) for part in night.sets]))
    counts = paper_exposures()[:, :2]
    of_paper = float(((counts - 1) * PAPER_SCATTERS[:, :2] ** 2).sum() / (counts - 1).sum())
    part = min(of_drift, PAPER_CORRELATION**2 * of_paper)
    strehl *= math.sqrt(part / of_drift) if of_drift > 0 else 0.0
    scale = math.sqrt(max(of_paper - part, variance) / np.mean(residual**2))
    return strehl + scale * rng.choice(residual, strehl.shape)
