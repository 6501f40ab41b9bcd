"""Statistics of loop results: paired differences, regression lines, gains in magnitude, with intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array, number_between
from faintspot.errors import InputError

Floats = NDArray[np.float64]

_DRAWS = 2000
_LEVEL = 0.95
_FEWEST_BLOCKS = 3  # or realisations: of fewer, drawing again says nothing
_SEED = 20150611  # of the resampling, when no generator is given: the same numbers give the same interval


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; NaN where there is none."""

    value: float
    low: float
    high: float
    count: int
    """Independent pieces that the interval is made of."""

    @property
    def decided(self) -> int:
        """1 when the whole interval is above 0, -1 when it is below, else 0."""
        return int(self.low > 0) - int(self.high < 0)


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
    gain: float
    """NaN when one of the curves does not reach it."""
    low: float
    high: float
    """95 % interval; infinite where more than 2.5 % of the draws left the measured magnitudes there."""
    why_not: str = ""
    """Why there is no gain, or no interval."""

    @property
    def decided(self) -> int:
        """1 when the whole interval is above 0, -1 when it is below, else 0."""
        return int(self.low > 0) - int(self.high < 0)


def mean_by_blocks(
    values: ArrayLike,
    block_length: int = 1,
    rng: np.random.Generator | None = None,
    comparisons: int = 1,
) -> Estimate:
    """Return the mean of a series with its interval by a moving-block bootstrap.

    Kuensch 1989 (Annals of Statistics 17, 1217): blocks of neighbouring values are drawn, so that values
    that resemble their neighbours do not make the interval too narrow. It is widened for the small number of
    blocks, as Student's t is against the normal distribution.

    Parameters
    ----------
    values : (n,) array
        In the order of time.
    block_length : int
        Neighbouring values drawn together.
    rng : numpy.random.Generator, optional
    comparisons : int
        Number of such intervals that are looked at together: all of them hold with 95 % (Bonferroni).

    Raises
    ------
    InputError
        When a value is not finite.
    """
    series = finite_array("values", values).astype(np.float64).ravel()
    count = len(series)
    length = int(number_between("block_length", block_length, 1, integer=True))
    length = min(length, max(1, count // _FEWEST_BLOCKS))
    blocks = math.ceil(count / length)
    value = float(series.mean())
    if blocks < _FEWEST_BLOCKS:
        return Estimate(value, math.nan, math.nan, blocks)
    rng = np.random.default_rng(_SEED) if rng is None else rng
    starts = rng.integers(0, count - length + 1, (_DRAWS, blocks))
    drawn = series[starts[:, :, None] + np.arange(length)].reshape(_DRAWS, -1)[:, :count].mean(axis=1)
    low, high = _widened(value, drawn, blocks, comparisons)
    return Estimate(value, low, high, blocks)


def paired_mean(differences: ArrayLike, comparisons: int = 1) -> Estimate:
    """Return the mean of independent differences, as of realisations, with its interval by Student's t.

    Parameters
    ----------
    differences : (R,) array
        NaN, of what is not measured yet, are left out.
    comparisons : int
        Number of such intervals that are looked at together: all of them hold with 95 % (Bonferroni).
    """
    values = np.asarray(differences, np.float64).ravel()
    values = values[np.isfinite(values)]
    count = len(values)
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    mean = float(values.mean())
    if count < 2:
        return Estimate(mean, math.nan, math.nan, count)
    half = _student(count - 1, comparisons) * float(values.std(ddof=1)) / math.sqrt(count)
    return Estimate(mean, mean - half, mean + half, count)


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
    half = _student(count - 2) * math.sqrt(left / (count - 2) / sum_xx)
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
        return MagnitudeGain(level, math.nan, math.nan, math.nan, "not measured yet")
    faint, curves = faint[order], [curve[order] for curve in curves]
    limits = [float(limiting_magnitudes(faint, curve.mean(axis=1), level)) for curve in curves]
    if any(math.isinf(limit) for limit in limits):
        return MagnitudeGain(level, math.nan, math.nan, math.nan, _why_not(limits))
    realisations = curves[0].shape[1]
    gain = limits[0] - limits[1]
    if realisations < _FEWEST_BLOCKS:
        return MagnitudeGain(level, gain, math.nan, math.nan, "too few realisations for an interval")
    rng = np.random.default_rng(_SEED) if rng is None else rng
    draws = rng.integers(0, realisations, (_DRAWS, realisations))
    ends = [limiting_magnitudes(faint, curve[:, draws].mean(axis=2).T, level) for curve in curves]
    low, high = _widened(gain, _differences(*ends), realisations)
    return MagnitudeGain(level, gain, low, high)


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


def _widened(value: float, drawn: Floats, pieces: int, comparisons: int = 1) -> tuple[float, float]:
    """Return the 95 % interval of bootstrap draws, widened about the value for few pieces.

    A bootstrap of n pieces has sqrt((n - 1) / n) of the scatter, and knows nothing of Student's t.
    """
    tail = 50 * (1 - _LEVEL)
    low, high = np.percentile(drawn, [tail, 100 - tail], method="nearest")
    factor = math.sqrt(pieces / (pieces - 1)) * _student(pieces - 1, comparisons) / 1.96
    return float(value + factor * (low - value)), float(value + factor * (high - value))


def _student(degrees: int, comparisons: int = 1) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(degrees, 1 - (1 - _LEVEL) / 2 / comparisons))
