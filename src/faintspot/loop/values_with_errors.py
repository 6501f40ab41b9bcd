"""Numbers as the reports of closed loops write them: none without its error."""

from __future__ import annotations

import math

from faintspot.compare.statistics import Estimate
from faintspot.loop.statistics import MagnitudeGain

NOTHING = "–"


def in_words(estimate: Estimate | None) -> str:
    """Return a difference in Strehl with its interval, as "+0.012 (−0.004 to +0.028)"."""
    if estimate is None or not math.isfinite(estimate.value):
        return NOTHING
    if not math.isfinite(estimate.low):
        return "too few for an interval"
    return f"{signed(estimate.value)} ({signed(estimate.low)} to {signed(estimate.high)})"


def gain_in_words(gain: MagnitudeGain) -> str:
    """Return a gain in magnitudes with its interval, or why there is none."""
    found = gain.gain
    if math.isnan(found.value) or math.isnan(found.low):
        return gain.why_not
    ends = [signed(end, 2) if math.isfinite(end) else "beyond" for end in (found.low, found.high)]
    return f"{signed(found.value, 2)} ({ends[0]} to {ends[1]})"


def with_error(estimate: Estimate, digits: int = 3) -> str:
    """Return a mean with its standard error, as "0.512 ±0.004"; "±?" where there is but one value."""
    if not math.isfinite(estimate.value):
        return NOTHING
    error = estimate.standard_error
    return f"{estimate.value:.{digits}f} ±{f'{error:.{digits}f}' if math.isfinite(error) else '?'}"


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, a minus as long as a plus."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")
