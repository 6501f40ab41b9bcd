"""Statistics of what is compared: slope errors with and without their gain, means of differences."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, number_between

OUTLIER_PX = 1.0
"""An error beyond this on either axis is an outlier: half the width of a Nyquist-sampled spot. It does not
scale with the errors' own spread, which would forgive a worse estimator more."""
FEWEST_PIECES = 3  # of fewer blocks or realisations, drawing again says nothing
DRAWS = 2000
SEED = 20150611  # of the resampling: the same numbers give the same interval
MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""
FWHM_TO_STD = 1.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))
"""Standard deviation of a Gaussian of full width at half maximum 1."""
_LEVEL = 0.95
_NORMAL = 1.959964
_WIDENING = 1.96  # standard errors on each side of an interval


def mad_std(values: NDArray[Any]) -> float:
    """Return the standard deviation of normal values, from their median absolute deviation."""
    return MAD_TO_STD * float(np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error and its 95 % interval; NaN where there is none."""

    value: float
    standard_error: float = math.nan
    low: float = math.nan
    high: float = math.nan
    """Default: 1.96 standard errors on each side of the value."""
    count: int = 0
    """Independent pieces that it comes from, where that is known."""

    def __post_init__(self) -> None:
        if math.isnan(self.low) and math.isnan(self.high) and math.isfinite(self.standard_error):
            object.__setattr__(self, "low", self.value - _NORMAL * self.standard_error)
            object.__setattr__(self, "high", self.value + _NORMAL * self.standard_error)

    @classmethod
    def of_mean(cls, samples: Floats) -> Estimate:
        """Return the mean of many independent samples with its standard error."""
        return cls(float(samples.mean()), float(samples.std() / np.sqrt(samples.size)), count=samples.size)

    def widened(self, error: float) -> Estimate:
        """Return the estimate with one more, independent standard error."""
        if math.isnan(self.low):
            return self
        value, wide = self.value, _WIDENING * error
        low, high = value - math.hypot(value - self.low, wide), value + math.hypot(self.high - value, wide)
        return Estimate(value, math.hypot(self.standard_error, error), low, high, self.count)

    @property
    def in_sigmas(self) -> float:
        """The value in units of its standard error; NaN where it has none."""
        error = self.standard_error
        return self.value / error if math.isfinite(error) and error > 0 else math.nan

    @property
    def decided(self) -> int:
        """1 when the whole interval is above 0, -1 when it is below, else 0."""
        return int(self.low > 0) - int(self.high < 0)


UNKNOWN = Estimate(math.nan)
"""A number that is not known."""


# Slope errors -------------------------------------------------------------------------------------------


def absolute_errors(x: ArrayLike, y: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return (|dx| + |dy|) / 2 of every slope: the terms whose mean is R.

    Parameters
    ----------
    x, y : (...) array, px
    truth : (..., 2) array, px

    Raises
    ------
    InputError
        When the shapes do not fit.
    """
    estimates = np.stack([finite_array("x", x), finite_array("y", y)], axis=-1).astype(np.float64)
    true_positions = finite_array("truth", truth)
    check_shape("truth", true_positions, estimates.shape)
    return np.mean(np.abs(estimates - true_positions), axis=-1)  # type: ignore[no-any-return]


def slope_error(x: ArrayLike, y: ArrayLike, truth: ArrayLike) -> Estimate:
    """Return R = mean of |estimate - truth| per axis, x and y averaged (Basden et al. 2015), in px."""
    errors = absolute_errors(x, y, truth)
    return Estimate.of_mean(errors)


@dataclass(frozen=True)
class SlopeStatistics:
    """Quality of slopes. R alone flatters an estimator that falls back to the reference."""

    error: Estimate
    """Slope error R, the mean of (|dx| + |dy|) / 2, px."""
    gain: Estimate
    """Slope of the estimate against the truth, x and y pooled; 1 where nothing is lost. NaN where the truth
    does not vary."""
    rms: Estimate
    """Root of the mean of (dx^2 + dy^2) / 2, px."""
    corrected_rms: Estimate
    """rms after offset and gain are taken off: of (estimate - offset) / gain - truth, px. What a control loop
    of the right gain is left with. Infinite where the gain is not above 0, NaN where it is not defined."""
    outlier_fraction: Estimate
    """Fraction of slopes with an error beyond `OUTLIER_PX` on either axis."""

    @property
    def ranking_rms(self) -> float:
        """The gain-corrected rms; infinite where it is not defined."""
        rms = self.corrected_rms.value
        return rms if math.isfinite(rms) else math.inf


def slope_statistics(x: ArrayLike, y: ArrayLike, truth: ArrayLike) -> SlopeStatistics:
    """Return error, gain, rms and outliers of slopes whose truth is known.

    Gain and offset are those of a linear regression of the estimate on the truth: an offset for each axis,
    one gain for both. Standard errors are those of independent pairs (x, y), to first order.

    Parameters
    ----------
    x, y : (...) array, px
    truth : (..., 2) array, px

    Raises
    ------
    InputError
        When the shapes do not fit, or there are no slopes.
    """
    error = absolute_errors(x, y, truth).ravel()
    estimate = np.stack([np.ravel(x), np.ravel(y)], axis=-1).astype(np.float64)
    true = np.asarray(truth, dtype=np.float64).reshape(-1, 2)
    gain, corrected_rms = _gain_and_corrected_rms(estimate, true)
    outlier = np.any(np.abs(estimate - true) > OUTLIER_PX, axis=1)
    return SlopeStatistics(
        Estimate.of_mean(error),
        gain,
        _root(Estimate.of_mean(np.mean(np.square(estimate - true), axis=1))),
        corrected_rms,
        Estimate.of_mean(outlier.astype(np.float64)),
    )


def _root(mean_square: Estimate) -> Estimate:
    """Root of a mean square, with its standard error to first order."""
    root = float(np.sqrt(mean_square.value))
    return Estimate(root, mean_square.standard_error / (2 * root) if root > 0 else 0.0)


def _gain_and_corrected_rms(
    estimate: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[Estimate, Estimate]:
    """Regression of (n, 2) estimates on the truth: its gain, and the rms of its residuals over the gain."""
    centred = truth - truth.mean(axis=0)
    spread = float(np.mean(np.square(centred)))
    if spread == 0.0:
        return UNKNOWN, UNKNOWN
    deviation = estimate - estimate.mean(axis=0)
    gain = float(np.mean(deviation * centred)) / spread
    residual = deviation - gain * centred
    moves_gain = np.mean(residual * centred, axis=1) / spread  # what each slope adds to the gain, times n
    root_n = np.sqrt(len(truth))
    gain_estimate = Estimate(gain, float(moves_gain.std() / root_n))
    if gain <= 0:
        return gain_estimate, Estimate(float("inf"), float("inf"))
    squares = np.mean(np.square(residual), axis=1)
    mean_square = float(squares.mean())
    if mean_square == 0.0:
        return gain_estimate, Estimate(0.0, 0.0)
    # Influence of each slope on the logarithm of mean_square / gain^2.
    influence = squares / mean_square - 2 * moves_gain / gain
    rms = float(np.sqrt(mean_square)) / gain
    return gain_estimate, Estimate(rms, rms / 2 * float(influence.std() / root_n))


# Means of differences ------------------------------------------------------------------------------------


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
        return UNKNOWN
    mean = float(values.mean())
    if count < 2:
        return Estimate(mean, count=count)
    error = float(values.std(ddof=1)) / math.sqrt(count)
    half = student(count - 1, comparisons) * error
    return Estimate(mean, error, mean - half, mean + half, count)


def mean_by_blocks(values: ArrayLike, block_length: int = 1, comparisons: int = 1) -> Estimate:
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
    length = min(length, max(1, count // FEWEST_PIECES))
    blocks = math.ceil(count / length)
    value = float(series.mean())
    if blocks < FEWEST_PIECES:
        return Estimate(value, count=blocks)
    starts = np.random.default_rng(SEED).integers(0, count - length + 1, (DRAWS, blocks))
    drawn = series[starts[:, :, None] + np.arange(length)].reshape(DRAWS, -1)[:, :count].mean(axis=1)
    return of_draws(value, drawn, blocks, comparisons)


def of_draws(value: float, drawn: Floats, pieces: int, comparisons: int = 1) -> Estimate:
    """Return a value with the standard error and the interval that bootstrap draws give it.

    Both are widened for few pieces: a bootstrap of n pieces has sqrt((n - 1) / n) of the scatter, and knows
    nothing of Student's t. The interval is infinite where more than 2.5 % of the draws are.
    """
    tail = 50 * (1 - _LEVEL)
    low, high = np.percentile(drawn, [tail, 100 - tail], method="nearest")
    finite = drawn[np.isfinite(drawn)]
    widened = math.sqrt(pieces / (pieces - 1))
    factor = widened * student(pieces - 1, comparisons) / _WIDENING
    return Estimate(
        value,
        widened * float(finite.std()) if len(finite) > 1 else math.nan,
        float(value + factor * (low - value)),
        float(value + factor * (high - value)),
        pieces,
    )


def student(degrees: int, comparisons: int = 1) -> float:
    """Return how many standard errors a 95 % interval reaches, for so many degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees, 1 - (1 - _LEVEL) / 2 / comparisons))


def rms(values: Floats) -> float:
    """Return the root mean square of the values that are not NaN; NaN when there is none."""
    kept = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else np.nan


def magnitudes(flux_ratio: float) -> float:
    """Return a flux ratio in magnitudes."""
    return float(2.5 * np.log10(flux_ratio))
