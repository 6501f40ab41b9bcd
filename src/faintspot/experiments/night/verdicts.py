"""Verdicts on the paper's statements about its observations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.alternation import coefficient
from faintspot.experiments.night.analysis import (
    ALL_STRENGTHS,
    BEST,
    Difference,
    contrast,
    differences,
    drift_of_r0,
    groups,
    hours_needed,
    lines,
    significance,
)
from faintspot.experiments.night.blocks import Night

HOLDS, FAILS, OPEN = "holds", "does not hold", "not decided"
_TEXT = Texts("faintspot.experiments.night")
_NO_ESTIMATE = Estimate(math.nan)


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
        return significance(self.measured)


def verdicts(night: Night) -> list[NightVerdict]:
    """Return the verdicts on the paper's four statements; none for a night without TV.

    A statement holds where the whole 95 % interval is above 0, and does not hold where it is below.
    """
    found = {group.name: group.rows for group in groups(night)}
    if ALL_STRENGTHS not in found:
        return []
    seeing = drift_of_r0(night)
    by_name = {each.name: each for each in differences(night)}
    verdict = [_of_difference("all", by_name[ALL_STRENGTHS])]
    if BEST in found:
        best, every = found[BEST], found[ALL_STRENGTHS]
        verdict.append(_of_difference("best", by_name[BEST]))
        measured = contrast(night, best, every & ~best, seeing)
        rows = every & np.isfinite(night.paired_strehl)
        paired = _NO_ESTIMATE
        if (rows & best).any() and (rows & ~best).any():
            design = np.column_stack([best[rows], np.ones(int(rows.sum()))]).astype(np.float64)
            change = (night.strehl - night.paired_strehl)[rows]
            paired = coefficient(design, change, night.middle_s[rows], night.cycle[rows], 0)
        effect = paired if math.isfinite(paired.value) else measured
        hours = float((night.duration_s[every] + night.overhead_s).sum()) / 3600
        needed = hours_needed(effect.value, measured.standard_error, hours)
        verdict.append(NightVerdict(_TEXT["statements.range"], measured, paired, "", needed))
    fits = lines(night)
    if fits:
        slope = fits[0].slope_per_cm
        needed = hours_needed(slope.value, slope.standard_error, night.hours)
        verdict.append(NightVerdict(_TEXT["statements.r0"], slope, _NO_ESTIMATE, " per cm", needed))
    return verdict


def _of_difference(name: str, difference: Difference) -> NightVerdict:
    paired = difference.paired or _NO_ESTIMATE
    return NightVerdict(_TEXT[f"statements.{name}"], difference.measured, paired, "", difference.hours_needed)


def _outcome(estimate: Estimate) -> str:
    return {1: HOLDS, -1: FAILS, 0: OPEN}[estimate.decided]
