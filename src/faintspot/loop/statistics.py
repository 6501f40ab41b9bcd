"""Statistics of loop results: differences from neighbours, regression lines, gains in magnitude."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array
from faintspot.compare.statistics import DRAWS, FEWEST_PIECES, SEED, Estimate, of_draws, student
from faintspot.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RegressionLine:
    """Least-squares line y = intercept + slope x."""

    slope: float
    intercept: float
    correlation: float
    """Pearson's; NaN when x or y does not vary."""
    slope_low: float
    slope_high: float
    """95 % interval of the slope, as if the points were independent."""
    count: int

    def __call__(self, x: ArrayLike) -> Floats:
        """Return the line's values."""
        return self.intercept + self.slope * np.asarray(x, np.float64)


@dataclass(frozen=True)
class MagnitudeGain:
    """How many magnitudes fainter an arm reaches the same Strehl ratio as the reference."""

    strehl: float
    gain: Estimate
    """NaN when one of the curves does not reach it; its interval is infinite where more than 2.5 % of the
    draws left the measured magnitudes there."""
    why_not: str = ""
    """Why there is no gain, or no interval."""


def neighbour_differences(values: ArrayLike, time: ArrayLike, reference: ArrayLike) -> Floats:
    """Return each value's difference from those of the reference just before and after it.

    Between two references it is taken from the straight line between them, so that what drifts slowly
    cancels; before the first and after the last from that one.

    Parameters
    ----------
    values, time : (n,) arrays
        In the order of time.
    reference : (n,) array of bool
        Which values are references; for them the result is NaN.

    Raises
    ------
    InputError
        When shapes differ, time does not rise, or there is no reference.
    """
    series, when = (
        finite_array(name, a).astype(np.float64) for name, a in (("values", values), ("time", time))
    )
    chosen = np.asarray(reference, np.bool_)
    if series.ndim != 1 or series.shape != when.shape or series.shape != chosen.shape:
        raise InputError(
            f"values, time, reference: expected the same number of each, got shapes {series.shape}, "
            f"{when.shape} and {chosen.shape}"
        )
    if (np.diff(when) <= 0).any():
        raise InputError("time: expected rising values")
    if not chosen.any():
        raise InputError("reference: expected at least one measurement without denoising")
    differences = series - np.interp(when, when[chosen], series[chosen])
    differences[chosen] = np.nan
    return differences


def regression_line(x: ArrayLike, y: ArrayLike) -> RegressionLine:
    """Return the least-squares line through points.

    Raises
    ------
    InputError
        When there are fewer than three points, shapes differ, or a value is not finite.
    """
    across, up = (
        finite_array(name, values).astype(np.float64).ravel() for name, values in (("x", x), ("y", y))
    )
    count = len(across)
    if count < 3 or len(up) != count:
        raise InputError(f"x, y: expected at least three points, got {count} and {len(up)}")
    dx, dy = across - across.mean(), up - up.mean()
    sum_xx, sum_yy, sum_xy = float(dx @ dx), float(dy @ dy), float(dx @ dy)
    if sum_xx == 0:
        return RegressionLine(0.0, float(up.mean()), math.nan, math.nan, math.nan, count)
    slope = sum_xy / sum_xx
    correlation = sum_xy / math.sqrt(sum_xx * sum_yy) if sum_yy > 0 else math.nan
    left = max(0.0, sum_yy - slope * sum_xy)
    half = student(count - 2) * math.sqrt(left / (count - 2) / sum_xx)
    return RegressionLine(
        slope, float(up.mean() - slope * across.mean()), correlation, slope - half, slope + half, count
    )


def magnitude_gain(
    magnitudes: ArrayLike,
    strehl: ArrayLike,
    reference: ArrayLike,
    level: float,
    rng: np.random.Generator | None = None,
) -> MagnitudeGain:
    """Return the gain in limiting magnitude at a Strehl ratio, with its interval over realisations.

    Each arm's mean curve is made to fall with magnitude (isotonic regression) and read off between its
    points, never beyond them. Realisations are drawn with replacement, the same ones for both arms.

    Parameters
    ----------
    magnitudes : (F,) array
    strehl, reference : (F, R) arrays
        Of the arm and of what it is compared with; the same realisations. NaN: not measured.
    level : float
        The Strehl ratio.
    rng : numpy.random.Generator, optional

    Raises
    ------
    InputError
        When shapes do not fit together.
    """
    faint = finite_array("magnitudes", magnitudes).astype(np.float64)
    curves = [np.asarray(values, np.float64) for values in (strehl, reference)]
    if faint.ndim != 1 or any(curve.ndim != 2 or curve.shape != curves[0].shape for curve in curves):
        raise InputError("strehl, reference: expected the same shape (magnitudes, realisations)")
    if len(curves[0]) != len(faint):
        raise InputError(f"strehl: expected {len(faint)} magnitudes, got {len(curves[0])}")
    whole = ~np.isnan(curves[0] + curves[1]).any(axis=1)
    order = np.flatnonzero(whole)[np.argsort(faint[whole])]
    if len(order) < 2:
        return MagnitudeGain(level, Estimate(math.nan), "not measured yet")
    faint, curves = faint[order], [curve[order] for curve in curves]
    limits = [float(limiting_magnitudes(faint, curve.mean(axis=1), level)) for curve in curves]
    if any(math.isinf(limit) for limit in limits):
        return MagnitudeGain(level, Estimate(math.nan), _why_not(limits))
    realisations = curves[0].shape[1]
    gain = limits[0] - limits[1]
    if realisations < FEWEST_PIECES:
        return MagnitudeGain(level, Estimate(gain), "too few realisations for an interval")
    rng = np.random.default_rng(SEED) if rng is None else rng
    draws = rng.integers(0, realisations, (DRAWS, realisations))
    ends = [limiting_magnitudes(faint, curve[:, draws].mean(axis=2).T, level) for curve in curves]
    return MagnitudeGain(level, of_draws(gain, _differences(*ends), realisations))


def limiting_magnitudes(magnitudes: ArrayLike, strehl: ArrayLike, level: float) -> Floats:
    """Return the magnitude at which each curve falls below a level, after `falling`.

    Infinite when it stays above within the magnitudes measured, minus infinite when it is never above.

    Parameters
    ----------
    magnitudes : (F,) array
        Rising.
    strehl : (..., F) array
    level : float
    """
    faint = np.asarray(magnitudes, np.float64)
    curves = falling(strehl)
    after = np.argmax(curves < level, axis=-1)[..., None]
    before = np.maximum(after - 1, 0)
    high, low = (np.take_along_axis(curves, place, -1)[..., 0] for place in (before, after))
    first, last = faint[before[..., 0]], faint[after[..., 0]]
    part = (high - level) / np.where(high > low, high - low, 1.0)
    crossing = first + part * (last - first)
    bounded = np.where(curves[..., -1] >= level, np.inf, crossing)
    return np.asarray(np.where(curves[..., 0] < level, -np.inf, bounded), np.float64)


def falling(values: ArrayLike) -> Floats:
    """Return the never rising series (..., F) nearest to `values` by least squares.

    By the min-max formula: at each place, the least over all beginnings before it of the largest over all
    ends after it of the mean between them (Robertson, Wright & Dykstra 1988, Order Restricted Statistical
    Inference, chapter 1).
    """
    series = np.asarray(values, np.float64)
    count = series.shape[-1]
    sums = np.concatenate([np.zeros((*series.shape[:-1], 1)), np.cumsum(series, axis=-1)], axis=-1)
    place = np.arange(count)
    lengths = place[None, :] + 1 - place[:, None]  # from begin (rows) to end (columns)
    means = (sums[..., None, 1:] - sums[..., :-1, None]) / np.maximum(lengths, 1)
    means = np.where(lengths > 0, means, -np.inf)
    largest = np.maximum.accumulate(means[..., ::-1], axis=-1)[..., ::-1]  # over ends at or after the column
    return np.asarray(np.where(lengths > 0, largest, np.inf).min(axis=-2), np.float64)


def _differences(ends: Floats, starts: Floats) -> Floats:
    """Return ends - starts; which of two infinite ones is fainter is not known, and they count as equal."""
    same = np.isinf(ends) & (ends == starts)
    return np.asarray(np.where(same, 0.0, ends) - np.where(same, 0.0, starts), np.float64)


def _why_not(limits: list[float]) -> str:
    sides = {math.inf: "above it", -math.inf: "below it"}
    parts = [
        f"{name}{sides[limit]} at all magnitudes"
        for name, limit in zip(("", "the reference is "), limits, strict=True)
        if limit in sides
    ]
    return "; ".join(parts)
