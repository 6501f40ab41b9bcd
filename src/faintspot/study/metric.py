"""The slope error R, and how much light a method saves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array, numbers_between
from faintspot.errors import InputError

_RESAMPLES = 500


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error."""

    value: float
    standard_error: float


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
    return Estimate(float(errors.mean()), float(errors.std() / np.sqrt(errors.size)))


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
        R at these fluxes; made monotonic first, as noise can make a curve rise.
    at_flux_e : float
        Flux of the plain method to compare with.

    Returns
    -------
    float
        Flux ratio, above 1 where the method needs less light; NaN where the method's curve does not reach
        that error.
    """
    from scipy.interpolate import PchipInterpolator

    log_flux = np.log(numbers_between("flux_e", flux_e, 0.0, low_open=True))
    plain, method = (np.minimum.accumulate(np.log(np.asarray(e))) for e in (errors_plain, errors_method))
    wanted = float(PchipInterpolator(log_flux, plain)(np.log(at_flux_e)))
    # The inverse needs strictly increasing abscissae; a step of 1e-12 is far below any error of R.
    falling = -method + 1e-12 * np.arange(len(method))
    if not falling[0] <= -wanted <= falling[-1]:
        return float("nan")
    return float(at_flux_e / np.exp(PchipInterpolator(falling, log_flux)(-wanted)))


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
    """
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
