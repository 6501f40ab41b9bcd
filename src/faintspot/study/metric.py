"""The slope error R, and how much light a method saves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array, number_between, numbers_between
from faintspot.errors import InputError

_RESAMPLES = 500
OUTLIER_PX = 1.0
"""An error beyond this on either axis is an outlier: half the width of a Nyquist-sampled spot. It does not
scale with the errors' own spread, which would forgive a worse estimator more."""


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error."""

    value: float
    standard_error: float

    @classmethod
    def of_mean(cls, samples: NDArray[np.float64]) -> Estimate:
        """Return the mean of independent samples with its standard error."""
        return cls(float(samples.mean()), float(samples.std() / np.sqrt(samples.size)))


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
    if estimates.shape != true_positions.shape:
        raise InputError(f"truth: expected shape {estimates.shape}, got {true_positions.shape}")
    return np.mean(np.abs(estimates - true_positions), axis=-1)  # type: ignore[no-any-return]


def slope_error(x: ArrayLike, y: ArrayLike, truth: ArrayLike) -> Estimate:
    """Return R = mean of |estimate - truth| per axis, x and y averaged (Basden et al. 2015), in px."""
    errors = absolute_errors(x, y, truth)
    return Estimate.of_mean(errors)


@dataclass(frozen=True)
class SlopeStatistics:
    """How good slopes are. R alone flatters an estimator that falls back to the reference."""

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
    """Fraction of slopes with an error beyond `outlier_px` on either axis."""
    invalid_fraction: Estimate
    """Fraction of slopes that are not valid; they count as they are in everything else."""


def slope_statistics(
    x: ArrayLike,
    y: ArrayLike,
    truth: ArrayLike,
    *,
    valid: ArrayLike | None = None,
    outlier_px: float = OUTLIER_PX,
) -> SlopeStatistics:
    """Return error, gain, rms and outliers of slopes whose truth is known.

    Gain and offset are those of a linear regression of the estimate on the truth: an offset for each axis,
    one gain for both. Standard errors are those of independent pairs (x, y), to first order.

    Parameters
    ----------
    x, y : (...) array, px
    truth : (..., 2) array, px
    valid : (...) array of bool, optional
        Which slopes were measured. Default: all.
    outlier_px : float
        Error on either axis beyond which a slope is an outlier.

    Raises
    ------
    InputError
        When the shapes do not fit, there are no slopes, or the limit is not above 0.
    """
    outlier_px = number_between("outlier_px", outlier_px, 0.0, low_open=True)
    estimate = np.stack([finite_array("x", x), finite_array("y", y)], axis=-1).astype(np.float64)
    error = absolute_errors(x, y, truth).ravel()
    measured = np.ones(estimate.shape[:-1], bool) if valid is None else np.asarray(valid, dtype=bool)
    if measured.shape != estimate.shape[:-1]:
        raise InputError(f"valid: expected shape {estimate.shape[:-1]}, got {measured.shape}")
    estimate = estimate.reshape(-1, 2)
    true = np.asarray(truth, dtype=np.float64).reshape(-1, 2)
    gain, corrected_rms = _gain_and_corrected_rms(estimate, true)
    outlier = np.any(np.abs(estimate - true) > outlier_px, axis=1)
    return SlopeStatistics(
        Estimate.of_mean(error),
        gain,
        _root(Estimate.of_mean(np.mean(np.square(estimate - true), axis=1))),
        corrected_rms,
        Estimate.of_mean(outlier.astype(np.float64)),
        Estimate.of_mean(1.0 - measured.ravel()),
    )


def _root(mean_square: Estimate) -> Estimate:
    """Root of a mean square, with its standard error to first order."""
    root = float(np.sqrt(mean_square.value))
    return Estimate(root, mean_square.standard_error / (2 * root) if root > 0 else 0.0)


def _gain_and_corrected_rms(
    estimate: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[Estimate, Estimate]:
    """Regression of (n, 2) estimates on the truth: its gain, and the rms of its residuals over the gain."""
    undefined = Estimate(float("nan"), float("nan"))
    centred = truth - truth.mean(axis=0)
    spread = float(np.mean(np.square(centred)))
    if spread == 0.0:
        return undefined, undefined
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


def flux_gain(
    flux_e: ArrayLike, errors_plain: ArrayLike, errors_method: ArrayLike, at_flux_e: float
) -> float:
    """Return by how much less light a method reaches the error that the plain one has at a flux.

    Both curves are interpolated monotonically (PCHIP) in log R against log flux.

    Parameters
    ----------
    flux_e : (n,) array
        Increasing.
    errors_plain, errors_method : (n,) arrays
        R at these fluxes, above 0; made monotonic first, as noise can make a curve rise.
    at_flux_e : float
        Flux of the plain method to compare with, within the range of `flux_e`.

    Returns
    -------
    float
        Flux ratio, above 1 where the method needs less light; NaN where the method's curve does not reach
        that error.

    Raises
    ------
    InputError
        For fluxes that do not increase, an error that is not above 0, or a flux out of range.
    """
    from scipy.interpolate import PchipInterpolator
    from scipy.optimize import brentq

    flux = numbers_between("flux_e", flux_e, 0.0, low_open=True)
    if flux.ndim != 1 or len(flux) < 2 or np.any(np.diff(flux) <= 0):
        raise InputError(f"flux_e: expected at least two increasing numbers, got {flux.tolist()}")
    at_flux_e = number_between("at_flux_e", at_flux_e, flux[0], flux[-1])
    log_flux = np.log(flux)
    plain = _falling_log("errors_plain", errors_plain, len(flux))
    method = _falling_log("errors_method", errors_method, len(flux))
    wanted = float(PchipInterpolator(log_flux, plain)(np.log(at_flux_e)))
    curve = PchipInterpolator(log_flux, method)
    highest, lowest = curve(log_flux[[0, -1]])
    if not lowest <= wanted <= highest:
        return float("nan")
    # The curve itself is inverted: interpolating log flux against log R would give equal curves a gain.
    found = brentq(lambda position: float(curve(position)) - wanted, log_flux[0], log_flux[-1])
    return float(at_flux_e / np.exp(found))


def _falling_log(name: str, errors: ArrayLike, n: int) -> NDArray[np.float64]:
    """Logarithm of a curve of errors, made to fall: where it would not, by 1e-9, far below any error of R."""
    array = numbers_between(name, errors, 0.0, low_open=True)
    if array.shape != (n,):
        raise InputError(f"{name}: expected shape ({n},), got {array.shape}")
    falling: NDArray[np.float64] = np.minimum.accumulate(np.log(array)) - 1e-9 * np.arange(n)
    return falling


def flux_gain_with_error(
    flux_e: ArrayLike,
    errors_plain: NDArray[np.float64],
    errors_method: NDArray[np.float64],
    at_flux_e: float,
    rng: np.random.Generator | None = None,
) -> Estimate:
    """Return the flux gain with its standard error, by resampling realisations.

    Parameters
    ----------
    flux_e : (n,) array
    errors_plain, errors_method : (n, m) arrays
        (|dx| + |dy|) / 2 of m realisations at each flux, the same ones in both: resampled together, so that
        what both share does not count.
    at_flux_e : float
    rng : numpy.random.Generator, optional

    Returns
    -------
    Estimate
        NaN, as `flux_gain`, where the error is not reached; resamples that do not reach it do not count.

    Raises
    ------
    InputError
        When the arrays do not have the same shape, and as `flux_gain`.
    """
    if np.ndim(errors_plain) != 2 or np.shape(errors_plain) != np.shape(errors_method):
        raise InputError(
            f"errors_plain, errors_method: expected two arrays of one shape (n, m), got "
            f"{np.shape(errors_plain)} and {np.shape(errors_method)}"
        )
    rng = np.random.default_rng() if rng is None else rng
    value = flux_gain(flux_e, errors_plain.mean(axis=1), errors_method.mean(axis=1), at_flux_e)
    n, m = errors_plain.shape
    gains: list[Any] = []
    for _ in range(_RESAMPLES):
        drawn = rng.integers(0, m, (n, m))
        plain = np.take_along_axis(errors_plain, drawn, axis=1).mean(axis=1)
        method = np.take_along_axis(errors_method, drawn, axis=1).mean(axis=1)
        gains.append(flux_gain(flux_e, plain, method, at_flux_e))
    reached = [gain for gain in gains if np.isfinite(gain)]
    return Estimate(value, float(np.std(reached)) if len(reached) > 1 else float("nan"))


def magnitudes(flux_ratio: float) -> float:
    """Return a flux ratio in magnitudes."""
    return float(2.5 * np.log10(flux_ratio))
