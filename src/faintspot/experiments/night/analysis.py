"""Differences between methods that alternated, with errors, and the hours that would show them."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import UNKNOWN, Estimate
from faintspot.experiments.night.alternation import coefficient, jackknife, predicted_by_others
from faintspot.experiments.night.protocol import BEST_STRENGTHS, Night

Rows = NDArray[np.bool_]

SIGMA = 3.0
"""Standard errors from which a difference counts as seen."""
STRENGTH_RANGES = ((0.0, 0.3), (0.3, 0.6), BEST_STRENGTHS, (1.1, 1.6), (1.6, math.inf))
"""Strengths taken together; one on an edge belongs to the paper's range, else to the lower range."""
ALL_STRENGTHS = "TV, all strengths"
BEST = f"TV, {BEST_STRENGTHS[0]:g} to {BEST_STRENGTHS[1]:g}"
_FEWEST_ROWS = 3
_FEWEST_SEEN = 10  # blocks with a measured r0


@dataclass(frozen=True)
class Difference:
    """Strehl ratio of a group minus that of the reference."""

    name: str
    blocks: int
    measured: Estimate
    """At equal r0, where it was measured."""
    without_r0: Estimate
    """Without r0 as a covariate."""
    paired: Estimate | None
    """Against the reference in the same turbulence at the same time; None where that is not known."""
    hours: float
    """Duration of the blocks of group and reference, settling included."""
    shared_error: float = 0.0
    """Part of the measured error that does not fall with time."""

    @property
    def hours_needed(self) -> float:
        """Hours of alternating until the effect is `SIGMA` standard errors; of the paired effect if known."""
        effect = self.measured if self.paired is None else self.paired
        return hours_needed(effect.value, self.measured.standard_error, self.hours, self.shared_error)

    @property
    def is_long_enough(self) -> bool:
        """Whether the night shows the effect with `SIGMA` standard errors."""
        return self.hours_needed <= self.hours


@dataclass(frozen=True)
class Regression:
    """Least-squares line of Strehl ratio against measured r0."""

    name: str
    slope_per_m: Estimate
    intercept: float
    correlation: float
    blocks: int

    @property
    def slope_per_cm(self) -> Estimate:
        """The slope for a centimetre of r0."""
        slope = self.slope_per_m
        value, error, low, high = np.array([slope.value, slope.standard_error, slope.low, slope.high]) / 100
        return Estimate(value, error, low, high, slope.count)


def groups(night: Night) -> dict[str, Rows]:
    """Return the blocks (B,) that are compared with the reference, by name.

    All strengths, those of the paper's column, other methods. A strength of 0 changes nothing and belongs to
    no group.
    """
    of_tv = {ALL_STRENGTHS: night.strength > 0, BEST: night.strengths_within(*BEST_STRENGTHS)}
    others = {
        label: (night.method == number) & np.isnan(night.strength)
        for number, label in enumerate(night.labels)
        if number != night.reference
    }
    return {name: rows for name, rows in (of_tv | others).items() if rows.any()}


def with_reference(night: Night) -> dict[str, Rows]:
    """Return the blocks of the reference and of each group, by name."""
    return {night.labels[night.reference]: night.is_reference, **groups(night)}


def differences(night: Night) -> list[Difference]:
    """Return the difference of each group from the reference."""
    seeing = drift_of_r0(night)
    return [difference(night, name, chosen, seeing) for name, chosen in groups(night).items()]


def difference(night: Night, name: str, chosen: Rows, seeing: Floats | None) -> Difference:
    """Return the difference of some blocks from the reference.

    Parameters
    ----------
    night : Night
    name : str
    chosen : (B,) array of bool
    seeing : (B,) array, optional
        See `drift_of_r0`.
    """
    reference = night.is_reference
    rows = (reference | chosen) & np.isfinite(night.strehl)
    paired = None
    known = chosen & np.isfinite(night.paired_strehl - night.strehl)
    if known.any():
        change = (night.strehl - night.paired_strehl)[known]
        one = np.ones((len(change), 1))
        paired = coefficient(one, change, night.middle_s[known], night.cycle[known], 0)
    seconds = night.duration_s[rows] + night.overhead_s
    return Difference(
        name,
        int(chosen.sum()),
        contrast(night, chosen, reference, seeing),
        contrast(night, chosen, reference, None),
        paired,
        float(seconds.sum()) / 3600,
        _shared_error(night, chosen & rows, reference & rows),
    )


def contrast(night: Night, chosen: Rows, others: Rows, seeing: Floats | None) -> Estimate:
    """Return the Strehl ratio of some blocks minus that of others.

    Sets have means of their own; with `seeing` the Strehl ratio is a parabola of it.
    """
    rows = (chosen | others) & np.isfinite(night.strehl)
    if min((chosen & rows).sum(), (others & rows).sum()) < _FEWEST_ROWS:
        return UNKNOWN
    columns = [part[rows].astype(np.float64) for part in (chosen, *night.sets)]
    if seeing is not None:
        away = seeing[rows] - seeing[rows].mean()
        columns += [away, away**2 - np.mean(away**2)]
    design = np.column_stack(columns)
    found = coefficient(design, night.strehl[rows], night.middle_s[rows], night.cycle[rows], 0)
    return found.widened(_shared_error(night, chosen & rows, others & rows))


def _shared_error(night: Night, chosen: Rows, others: Rows) -> float:
    """Return the error of a difference that its blocks have in common."""
    if night.shared_error is None or not (chosen.any() and others.any()):
        return 0.0
    return abs(float(night.shared_error[chosen].mean() - night.shared_error[others].mean()))


def drift_of_r0(night: Night) -> Floats | None:
    """Return the logarithm of r0 as it drifts, (B,), from the measured r0 of all blocks; None without.

    Each method may measure r0 with an error of its own, which would pass for a difference between methods.
    Therefore the r0 of a block is what the blocks of the other methods before and after it predict.
    """
    known = np.isfinite(night.r0_m) & (night.r0_m > 0)
    if known.sum() < _FEWEST_SEEN or len(np.unique(night.method[known])) < 2:
        return None
    time_s = night.middle_s
    part = predicted_by_others(np.log(night.r0_m[known]), time_s[known], night.method[known])
    return np.interp(time_s, time_s[known], part)


def by_strength(night: Night) -> list[tuple[float, Difference]]:
    """Return the mean strength and the difference from the reference of each range of strengths."""
    seeing, strength, found = drift_of_r0(night), night.strength, []
    best = night.strengths_within(*BEST_STRENGTHS)
    for low, high in STRENGTH_RANGES:
        rows = best if (low, high) == BEST_STRENGTHS else (strength > low) & (strength <= high) & ~best
        if rows.sum() >= _FEWEST_ROWS:
            name = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
            compared = difference(night, f"{name} {night.strength_unit}", rows, seeing)
            found.append((float(strength[rows].mean()), compared))
    return found


def lines(night: Night) -> list[Regression]:
    """Return Strehl ratio against measured r0 as a line, for the reference and each group."""
    every = with_reference(night).items()
    return [line for name, chosen in every if (line := _line(night, name, chosen)) is not None]


def _line(night: Night, name: str, chosen: Rows) -> Regression | None:
    rows = chosen & np.isfinite(night.r0_m + night.strehl)
    r0, strehl = night.r0_m[rows], night.strehl[rows]
    if len(r0) < _FEWEST_ROWS or np.ptp(r0) == 0 or np.ptp(strehl) == 0:
        return None
    slope, intercept = np.polyfit(r0, strehl, 1)
    cycle = night.cycle[rows]
    without = [
        float(np.polyfit(r0[cycle != number], strehl[cycle != number], 1)[0])
        for number in np.unique(cycle)
        if np.unique(r0[cycle != number]).size > 1
    ]
    correlation = float(np.corrcoef(r0, strehl)[0, 1])
    return Regression(name, jackknife(float(slope), without), float(intercept), correlation, len(r0))


def hours_needed(effect: float, error: float, hours: float, shared_error: float = 0.0) -> float:
    """Return the hours after which an effect is `SIGMA` standard errors, whose square falls with time.

    Infinite where no time is long enough.

    Parameters
    ----------
    effect : float
    error : float
        Its standard error after `hours`.
    hours : float
    shared_error : float
        Part of the error that does not fall with time.
    """
    if not (math.isfinite(effect) and math.isfinite(error)):
        return math.nan
    left = (effect / SIGMA) ** 2 - shared_error**2
    return hours * max(error**2 - shared_error**2, 0.0) / left if left > 0 else math.inf


def group_means(night: Night, rows: Rows) -> list[dict[str, float]]:
    """Return mean, standard deviation and number of some blocks in each set, and in all of them."""
    found = []
    for part in (*night.sets, np.ones_like(rows)):
        values = night.strehl[rows & part & np.isfinite(night.strehl)]
        mean = float(values.mean()) if len(values) else math.nan
        scatter = float(values.std(ddof=1)) if len(values) > 1 else math.nan
        found.append({"mean": mean, "standard_deviation": scatter, "blocks": len(values)})
    return found


HOLDS, FAILS, OPEN = "holds", "does not hold", "not decided"
_TEXT = Texts("faintspot.experiments.night")


@dataclass(frozen=True)
class NightVerdict:
    """Verdict on one statement."""

    statement: str
    """In our words."""
    measured: Estimate
    """Difference that is above 0 if the statement holds, from the alternating observations."""
    paired: Estimate
    """The same from the same turbulence; NaN where that is not known."""
    unit: str
    hours_needed: float
    """Hours of alternating for 3 standard errors of the paired effect, else of the measured one."""

    @property
    def is_paired(self) -> bool:
        """Whether the effect in the same turbulence is known."""
        return math.isfinite(self.paired.value)

    @property
    def outcome(self) -> str:
        """Verdict of the alternating observations."""
        return _outcome(self.measured)

    @property
    def paired_outcome(self) -> str:
        """Verdict of the same turbulence; "" where it is not known."""
        return _outcome(self.paired) if self.is_paired else ""

    @property
    def significance(self) -> float:
        """The measured effect in standard errors."""
        return self.measured.in_sigmas


def verdicts(night: Night) -> list[NightVerdict]:
    """Return the verdicts on the paper's four statements; none for a night without TV.

    A statement holds where the whole 95 % interval is above 0, and does not hold where it is below.
    """
    found = groups(night)
    if ALL_STRENGTHS not in found:
        return []
    seeing = drift_of_r0(night)
    by_name = {each.name: each for each in differences(night)}
    verdict = [_of_difference("all", by_name[ALL_STRENGTHS])]
    if BEST in found:
        best, every = found[BEST], found[ALL_STRENGTHS]
        verdict.append(_of_difference("best", by_name[BEST]))
        measured = contrast(night, best, every & ~best, seeing)
        rows, paired = every & np.isfinite(night.paired_strehl), UNKNOWN
        if (rows & best).any() and (rows & ~best).any():
            design = np.column_stack([best[rows], np.ones(int(rows.sum()))]).astype(np.float64)
            change = (night.strehl - night.paired_strehl)[rows]
            paired = coefficient(design, change, night.middle_s[rows], night.cycle[rows], 0)
        hours = float((night.duration_s[every] + night.overhead_s).sum()) / 3600
        verdict.append(_verdict("range", measured, paired, hours))
    fits = lines(night)
    if fits:
        verdict.append(_verdict("r0", fits[0].slope_per_cm, UNKNOWN, night.hours, unit=" per cm"))
    return verdict


def _of_difference(name: str, found: Difference) -> NightVerdict:
    return _verdict(name, found.measured, found.paired or UNKNOWN, found.hours, found.shared_error)


def _verdict(
    name: str, measured: Estimate, paired: Estimate, hours: float, shared_error: float = 0.0, unit: str = ""
) -> NightVerdict:
    effect = paired if math.isfinite(paired.value) else measured
    needed = hours_needed(effect.value, measured.standard_error, hours, shared_error)
    return NightVerdict(_TEXT[f"statements.{name}"], measured, paired, unit, needed)


def _outcome(estimate: Estimate) -> str:
    return {1: HOLDS, -1: FAILS, 0: OPEN}[estimate.decided]
