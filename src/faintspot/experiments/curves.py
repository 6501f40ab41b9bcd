"""Curves of the slope error against the flux, and the flux that a method saves, with intervals.

The Strehl ratio of a closed loop against the star's magnitude is no such curve: there the same few
realisations of the air are seen at every magnitude, and whole realisations are drawn again, while here each
flux has means of thousands of spots whose errors are normal and independent of those of other fluxes. Both
give an `Estimate`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.statistics import UNKNOWN, Estimate, magnitudes
from faintspot.experiments.methods import crossings

CONFIDENCE = 0.95
_RESAMPLES = 400
_SMALLEST_ERROR_PX = 1e-6  # of a resampled R


@dataclass(frozen=True)
class Curve:
    """The slope error R of all methods at increasing flux, px; the methods have seen the same spots."""

    flux_e: Floats
    """(n_flux,)"""
    methods: tuple[str, ...]
    error: Floats
    """(n_flux, n_methods)."""
    covariance: Floats
    """(n_flux, n_methods, n_methods) of the means, px^2."""

    @classmethod
    def of_errors(cls, flux_e: ArrayLike, errors: Mapping[str, ArrayLike]) -> Curve:
        """Return the curve of the errors (|dx| + |dy|) / 2 of each spot, (n_flux, n) px for every method.

        Raises
        ------
        InputError
            For fluxes that do not increase, or errors of other shapes.
        """
        flux = numbers_between("flux_e", flux_e, 0.0, low_open=True).astype(np.float64)
        if flux.ndim != 1 or len(flux) < 2 or np.any(np.diff(flux) <= 0):
            raise InputError(f"flux_e: expected at least two increasing numbers, got {flux.tolist()}")
        shapes = {np.shape(values) for values in errors.values()}
        if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or shape[0] != len(flux):
            raise InputError(f"errors: expected arrays of one shape ({len(flux)}, n) for all methods")
        every = np.stack([np.asarray(values, np.float64) for values in errors.values()])
        mean = every.mean(axis=2)
        centred = every - mean[..., None]
        covariance = np.einsum("ifn,jfn->fij", centred, centred) / shape[1] ** 2
        return cls(flux, tuple(errors), mean.T, covariance)

    def of(self, method: str) -> Floats:
        """Return R of a method, (n_flux,)."""
        return self.error[:, self._index(method)]

    def se_of(self, method: str) -> Floats:
        """Return the standard error of R of a method."""
        index = self._index(method)
        return np.sqrt(self.covariance[:, index, index])

    def has(self, *methods: str) -> bool:
        """Whether these methods are measured."""
        return all(method in self.methods for method in methods)

    def difference(self, method: str, reference: str) -> tuple[Floats, Floats]:
        """Return R of `reference` minus R of `method` at each flux and its paired standard error."""
        i, j = self._index(method), self._index(reference)
        covariance = self.covariance
        variance = covariance[:, i, i] + covariance[:, j, j] - 2 * covariance[:, i, j]
        return self.error[:, j] - self.error[:, i], np.sqrt(np.maximum(variance, 0.0))

    def at(self, flux_e: float, method: str) -> Estimate | None:
        """Return R at that flux; None when there is none."""
        error = self.of(method)
        for index in np.flatnonzero(np.isclose(self.flux_e, flux_e) & np.isfinite(error)):
            return Estimate(float(error[index]), float(self.se_of(method)[index]))
        return None

    def _index(self, method: str) -> int:
        if method not in self.methods:
            raise InputError(f"method {method!r}: expected one of {', '.join(self.methods)}")
        return self.methods.index(method)


@dataclass(frozen=True)
class Gain:
    """By what factor less flux a method reaches the same R, with its confidence interval."""

    factor: float
    """inf: the method's R is smaller than that at the lowest flux measured; 0: it never gets there."""
    low: float
    high: float
    log_samples: Floats
    """Natural logarithm of the bootstrap's factors."""

    @property
    def in_magnitudes(self) -> Estimate:
        """The gain and its interval in magnitudes."""
        with np.errstate(divide="ignore"):
            value, low, high = (magnitudes(factor) for factor in (self.factor, self.low, self.high))
        error = magnitudes(math.e) * self.log_se if math.isfinite(value + self.log_se) else math.nan
        return Estimate(value, error, low, high)

    @property
    def is_bounded(self) -> bool:
        """Whether the method's flux is within those measured; below the lowest, no upper end is known."""
        return bool(np.isfinite(self.high))

    @property
    def log_se(self) -> float:
        """Standard error of ln(factor), from the interquartile range: samples may be infinite."""
        if not np.isfinite(self.log_samples).mean() > 0.8:
            return float("inf")
        low, high = np.percentile(self.log_samples, [25, 75], method="nearest")
        return float((high - low) / 1.349)

    def in_words(self) -> str:
        """Return "1.43 (1.36 to 1.50)"."""
        return f"{_factor(self.factor)} ({_factor(self.low)} to {_factor(self.high)})"


def gain_at_flux(
    curve: Curve, flux_e: float, rng: np.random.Generator, *, method: str, reference: str
) -> Gain | None:
    """Return by how much less flux `method` reaches the R that `reference` has at a flux.

    log R is interpolated monotonically (PCHIP) in log flux. The 95 % interval is a parametric bootstrap: R of
    both methods is drawn from the normal distribution of their standard errors and covariance.

    Returns
    -------
    Gain or None
        None when the flux is outside the curve or a curve has fewer than two points.

    Raises
    ------
    InputError
        For a flux that is not above 0 or an unknown method.
    """
    flux_e = number_between("flux_e", flux_e, 0.0, low_open=True)
    knots, curves = _resampled(curve, reference, method, rng)
    if not len(knots) or not knots[0] - 1e-9 <= np.log(flux_e) <= knots[-1] + 1e-9:
        return None
    from scipy.interpolate import PchipInterpolator

    log_flux = np.clip(np.log(flux_e), knots[0], knots[-1])
    log_error = PchipInterpolator(knots, curves[0], axis=-1)(log_flux)
    return _gain(log_flux - crossings(knots, curves[1], log_error))


def gain_at_error(
    curve: Curve, error_px: float, rng: np.random.Generator, *, method: str, reference: str
) -> Gain | None:
    """Return by how much less flux `method` reaches a given R than `reference`; see `gain_at_flux`.

    Returns
    -------
    Gain or None
        None when `reference` does not have that R within the curve, or a curve has fewer than two points.

    Raises
    ------
    InputError
        For an error that is not above 0 or an unknown method.
    """
    error_px = number_between("error_px", error_px, 0.0, low_open=True)
    knots, curves = _resampled(curve, reference, method, rng)
    if not len(knots):
        return None
    log_flux, of_method = crossings(knots, curves, np.log(error_px))
    if not np.isfinite(log_flux[0]):
        return None
    finite = np.isfinite(log_flux)  # resamples in which the reference just misses that error
    return _gain(log_flux[finite] - of_method[finite])


def magnitude_gain(
    curve: Curve, flux_e: float, rng: np.random.Generator, *, method: str, reference: str
) -> Estimate:
    """Return how many magnitudes fainter a star may be with `method` for R of `reference` at a flux.

    Returns
    -------
    Estimate
        Infinite where the method's R is smaller on its whole curve, minus infinity where it is larger; NaN as
        `gain_at_flux`.
    """
    if method == reference:
        return Estimate(0.0, 0.0)
    gain = gain_at_flux(curve, flux_e, rng, method=method, reference=reference)
    return UNKNOWN if gain is None else gain.in_magnitudes


def limiting_flux(curve: Curve, method: str, budget_px: float, rng: np.random.Generator) -> Estimate:
    """Return the flux at which R of a method equals a budget.

    Returns
    -------
    Estimate
        0 where R is below the budget on the whole curve, infinite where it is above; NaN where a curve has
        fewer than two points.

    Raises
    ------
    InputError
        For a budget that is not above 0 or an unknown method.
    """
    budget_px = number_between("budget_px", budget_px, 0.0, low_open=True)
    knots, curves = _resampled(curve, method, method, rng)
    if not len(knots):
        return UNKNOWN
    flux = np.exp(crossings(knots, curves[1], np.log(budget_px)))
    drawn = flux[1:][np.isfinite(flux[1:]) & (flux[1:] > 0)]
    is_known = 0 < flux[0] < np.inf and len(drawn) > 1
    return Estimate(float(flux[0]), float(drawn.std()) if is_known else math.nan)


def _resampled(curve: Curve, reference: str, method: str, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return log flux (n,) and falling curves of log R, (2, 1 + resamples, n), the first as measured.

    Of reference and method; n is 0 where fewer than two points are measured.
    """
    pair = [curve.methods.index(method) for method in (reference, method) if curve.has(method)]
    if len(pair) < 2:
        raise InputError(f"methods {reference!r} and {method!r}: expected two of {', '.join(curve.methods)}")
    kept = np.all(np.isfinite(curve.error[:, pair]), axis=1)
    if np.count_nonzero(kept) < 2:
        return np.zeros(0), np.zeros((2, 1, 0))
    error = curve.error[kept][:, pair]
    covariance = curve.covariance[kept][:, pair][:, :, pair]
    variances, axes = np.linalg.eigh(covariance)
    normal = rng.standard_normal((_RESAMPLES, *error.shape))
    drawn = error + np.einsum("fij,fj,sfj->sfi", axes, np.sqrt(np.maximum(variances, 0.0)), normal)
    every = np.maximum(np.concatenate([error[None], drawn]), _SMALLEST_ERROR_PX)
    # Made to fall: where noise makes a curve rise, by 1e-9, far below any error of R.
    falling = np.minimum.accumulate(np.log(every), axis=1) - 1e-9 * np.arange(error.shape[0])[:, None]
    return np.log(curve.flux_e[kept]), np.moveaxis(falling, -1, 0)


def _gain(log_factors: Floats) -> Gain:
    tail = 50 * (1 - CONFIDENCE)
    # "nearest" never averages with an infinite sample.
    low, high = np.percentile(log_factors[1:], [tail, 100 - tail], method="nearest")
    return Gain(float(np.exp(log_factors[0])), float(np.exp(low)), float(np.exp(high)), log_factors[1:])


def _factor(value: float) -> str:
    if value == 0:
        return "less than any measured"
    return "more than any measured" if np.isinf(value) else f"{value:.2f}"
