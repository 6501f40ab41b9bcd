"""Numbers with their errors in words, for tables and sentences."""

from __future__ import annotations

import math

from faintspot.base.statistics import Estimate

NOTHING = "–"


def plain_number(value: float, digits: int = 3) -> str:
    """Return a number to so many digits, without an exponent up to a million."""
    return f"{float(f'{value:.{digits}g}'):g}"


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, a minus as long as a plus."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")


def number_or_dash(value: float, digits: int = 2) -> str:
    """Return a number to so many decimals, a dash where there is none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else NOTHING


def with_error(estimate: Estimate, digits: int = 3, *, sign: bool = False, smallest: float = 0.0) -> str:
    """Return a value with its standard error, at least `smallest`, as "0.512 ± 0.004".

    The value alone where there is no error, a dash where there is no value.
    """
    if not math.isfinite(estimate.value):
        return NOTHING
    text = signed(estimate.value, digits) if sign else f"{estimate.value:.{digits}f}"
    if not math.isfinite(estimate.standard_error):
        return text
    return f"{text} ± {max(estimate.standard_error, smallest):.{digits}f}"


def with_interval(estimate: Estimate | None, digits: int = 3) -> str:
    """Return a difference with its 95 % interval, as "+0.012 (−0.004 to +0.028)"."""
    if estimate is None or math.isnan(estimate.value):
        return NOTHING
    if math.isinf(estimate.value):
        return "more than was measured" if estimate.value > 0 else "less than was measured"
    if math.isnan(estimate.low):
        return "too few for an interval"
    ends = [signed(end, digits) if math.isfinite(end) else "beyond" for end in (estimate.low, estimate.high)]
    return f"{signed(estimate.value, digits)} ({ends[0]} to {ends[1]})"
