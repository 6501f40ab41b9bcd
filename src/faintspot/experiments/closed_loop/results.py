"""Results of closed-loop experiments: their files, and comparisons with errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array
from faintspot.base.errors import InputError
from faintspot.base.statistics import DRAWS, FEWEST_PIECES, SEED, Estimate, of_draws, paired_mean
from faintspot.loop.simulation.files import Stored

Floats = NDArray[np.float64]
_STREHL_LEVELS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@dataclass(frozen=True, eq=False)
class MagnitudeResult(Stored):
    """Strehl ratio against the star's flux: A methods, F fluxes, R realisations of the air."""

    WHAT: ClassVar[str] = "a magnitude experiment"
    FORMAT: ClassVar[int] = 4

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.experiments.closed_loop.methods.method_kind`."""
    labels: tuple[str, ...]
    """(A,)"""
    photons: Floats
    """(F,): photo-electrons of a fully lit sub-aperture in a frame."""
    magnitudes: Floats
    """(F,)"""
    strehl: Floats
    """(A, F, R): long exposure; NaN where not measured yet."""
    centroid_gain: Floats
    """(A, F, R)"""
    settings: NDArray[np.str_]
    """(A, F): TOML text of the tuned settings; "" where not tuned yet."""
    choices: NDArray[np.str_]
    """(A, F): JSON text of the tuned values, loop gain included; "{}" where not tuned yet."""
    configuration: str
    """TOML text."""


@dataclass(frozen=True, eq=False)
class BudgetResult(Stored):
    """Error budget: A methods with T terms switched off, R realisations of the air."""

    WHAT: ClassVar[str] = "an error budget"
    FORMAT: ClassVar[int] = 2

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.experiments.closed_loop.methods.method_kind`."""
    terms: tuple[str, ...]
    """(T,): what is switched off; the first is nothing."""
    labels: tuple[str, ...]
    """(A,)"""
    strehl: Floats
    """(A, T, R): long exposure; NaN where not measured yet."""
    residual_nm: Floats
    """(A, T, R): rms of the wavefront after the mirror, root of the mean square over the frames."""


def differences_by_flux(result: MagnitudeResult, method: int, reference: int) -> list[Estimate]:
    """Return a method's Strehl less the reference's at each flux, over realisations.

    The intervals hold together, for all fluxes, with 95 %.
    """
    fluxes = len(result.photons)
    return [
        paired_mean(result.strehl[method, f] - result.strehl[reference, f], fluxes) for f in range(fluxes)
    ]


def gains_in_magnitude(result: MagnitudeResult, method: int, reference: int) -> dict[float, Estimate]:
    """Return the gain in limiting magnitude at each Strehl ratio that the reference's curve passes."""
    curve = np.array([paired_mean(values).value for values in result.strehl[reference]])
    finite = curve[np.isfinite(curve)]
    return {
        level: magnitude_gain(result.magnitudes, result.strehl[method], result.strehl[reference], level)
        for level in _STREHL_LEVELS
        if len(finite) and finite.min() < level <= finite.max()
    }


def magnitude_gain(
    magnitudes: ArrayLike,
    strehl: ArrayLike,
    reference: ArrayLike,
    level: float,
    rng: np.random.Generator | None = None,
) -> Estimate:
    """Return the gain in limiting magnitude at a Strehl ratio, with its interval over realisations.

    Each method's mean curve is made to fall with magnitude (isotonic regression) and read off between its
    points, never beyond them. Realisations are drawn with replacement, the same ones for both methods.

    Parameters
    ----------
    magnitudes : (F,) array
    strehl, reference : (F, R) arrays
        Of the method and of what it is compared with; the same realisations. NaN: not measured.
    level : float
        The Strehl ratio.
    rng : numpy.random.Generator, optional

    Returns
    -------
    Estimate
        Infinite where the method's curve stays above the level and the reference's does not, minus infinite
        where it stays below; NaN where neither crosses it, or nothing is measured yet. An end of the interval
        is infinite where more than 2.5 % of the draws left the measured magnitudes there.

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
    complete = ~np.isnan(curves[0] + curves[1]).any(axis=1)
    order = np.flatnonzero(complete)[np.argsort(faint[complete])]
    if len(order) < 2:
        return Estimate(math.nan)
    faint, curves = faint[order], [curve[order] for curve in curves]
    limits = [float(limiting_magnitudes(faint, curve.mean(axis=1), level)) for curve in curves]
    realisations = curves[0].shape[1]
    gain = limits[0] - limits[1]
    if not math.isfinite(gain) or realisations < FEWEST_PIECES:
        return Estimate(gain)
    rng = np.random.default_rng(SEED) if rng is None else rng
    draws = rng.integers(0, realisations, (DRAWS, realisations))
    ends = [limiting_magnitudes(faint, curve[:, draws].mean(axis=2).T, level) for curve in curves]
    return of_draws(gain, _differences(*ends), realisations)


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
    high, low = (np.take_along_axis(curves, index, -1)[..., 0] for index in (before, after))
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
    index = np.arange(count)
    lengths = index[None, :] + 1 - index[:, None]  # from begin (rows) to end (columns)
    means = (sums[..., None, 1:] - sums[..., :-1, None]) / np.maximum(lengths, 1)
    means = np.where(lengths > 0, means, -np.inf)
    largest = np.maximum.accumulate(means[..., ::-1], axis=-1)[..., ::-1]  # over ends at or after the column
    return np.asarray(np.where(lengths > 0, largest, np.inf).min(axis=-2), np.float64)


def _differences(ends: Floats, starts: Floats) -> Floats:
    """Return ends - starts; which of two infinite ones is fainter is not known, and they count as equal."""
    same = np.isinf(ends) & (ends == starts)
    return np.asarray(np.where(same, 0.0, ends) - np.where(same, 0.0, starts), np.float64)
