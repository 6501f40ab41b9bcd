"""Results of closed-loop experiments: their files, and comparisons with errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array
from faintspot.base.errors import InputError
from faintspot.base.files import NpzFile
from faintspot.base.report.texts import with_error
from faintspot.base.statistics import DRAWS, FEWEST_PIECES, SEED, Estimate, of_draws, paired_mean
from faintspot.experiments.methods import crossings

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Limit:
    """Magnitude at which a Strehl curve falls below a level, or the distance of two curves there."""

    magnitude: Estimate
    """Infinite: above the level with every star that was measured; minus infinite: below it."""
    interpolation_error: float
    """Error of interpolation between measured stars: the difference from straight lines."""

    @property
    def is_known(self) -> bool:
        """Whether it is within what was measured."""
        return math.isfinite(self.magnitude.value)

    @property
    def error(self) -> float:
        """Standard error, both kinds together; NaN with too few realisations."""
        return math.hypot(self.magnitude.standard_error, self.interpolation_error)

    @property
    def estimate(self) -> Estimate:
        """Value and interval with both kinds of error."""
        return self.magnitude.widened(self.interpolation_error)

    def in_words(self, *, sign: bool = False) -> str:
        """Return it with its error, at least 0.01 mag."""
        return with_error(Estimate(self.magnitude.value, self.error), 2, sign=sign, smallest=0.01)


def magnitude_limit(magnitudes: ArrayLike, strehl: ArrayLike, level: float) -> Limit:
    """Return the limiting magnitude at a Strehl ratio; parameters are those of `magnitude_gain`."""
    return _limit(*_complete(magnitudes, strehl), level)


def magnitude_gain(magnitudes: ArrayLike, strehl: ArrayLike, reference: ArrayLike, level: float) -> Limit:
    """Return the gain in limiting magnitude at a Strehl ratio, with its interval over realisations.

    Each method's mean curve is made to fall with magnitude (isotonic regression) and interpolated by a
    monotone cubic between its points, never beyond them. Realisations are drawn with replacement, the same
    ones for both methods. Curves that bend alike are wrong alike: the error of interpolation is the change
    that it makes to the gain.

    Parameters
    ----------
    magnitudes : (F,) array
    strehl, reference : (F, R) arrays
        Of the method and of what it is compared with; the same realisations. NaN: not measured.
    level : float
        The Strehl ratio.

    Returns
    -------
    Limit
        Infinite where the method's curve stays above the level and the reference's does not, minus infinite
        where it stays below; NaN where neither crosses it, or nothing is measured yet. An end of the interval
        is infinite where more than 2.5 % of the draws left the measured magnitudes there.

    Raises
    ------
    InputError
        When shapes do not fit together.
    """
    return _limit(*_complete(magnitudes, strehl, reference), level)


def _complete(magnitudes: ArrayLike, *strehl: ArrayLike) -> tuple[Floats, list[Floats]]:
    """Return magnitudes that all curves (F, R) were measured at, rising, and the curves."""
    faint = finite_array("magnitudes", magnitudes).astype(np.float64)
    curves = [np.asarray(values, np.float64) for values in strehl]
    if faint.ndim != 1 or any(curve.ndim != 2 or curve.shape != curves[0].shape for curve in curves):
        raise InputError("strehl, reference: expected the same shape (magnitudes, realisations)")
    if len(curves[0]) != len(faint):
        raise InputError(f"strehl: expected {len(faint)} magnitudes, got {len(curves[0])}")
    complete = ~np.isnan(sum(curves)).any(axis=1)
    order = np.flatnonzero(complete)[np.argsort(faint[complete])]
    return faint[order], [curve[order] for curve in curves]


def _limit(faint: Floats, curves: list[Floats], level: float) -> Limit:
    """Return the limit of one curve, or the difference of those of two."""
    if len(faint) < 2:
        return Limit(Estimate(math.nan), 0.0)

    def read_off(*, straight: bool) -> float:
        found = (crossings(faint, falling(curve.mean(axis=1)), level, straight=straight) for curve in curves)
        first, *others = map(float, found)
        return first - sum(others)

    value, realisations = read_off(straight=False), curves[0].shape[1]
    if not math.isfinite(value):
        return Limit(Estimate(value), 0.0)
    between = abs(read_off(straight=True) - value)
    if len(faint) == 2:  # no bend is seen: each curve may cross anywhere between the two
        between = math.sqrt(len(curves) / 12) * float(faint[1] - faint[0])
    if realisations < FEWEST_PIECES:
        return Limit(Estimate(value), between)
    draws = np.random.default_rng(SEED).integers(0, realisations, (DRAWS, realisations))
    ends = [crossings(faint, falling(curve[:, draws].mean(axis=2).T), level) for curve in curves]
    drawn = ends[0] if len(ends) == 1 else _differences(*ends)
    return Limit(of_draws(value, drawn, realisations), between)


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


_STREHL_LEVELS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@dataclass(frozen=True, eq=False)
class MagnitudeResult(NpzFile):
    """Strehl ratio against the star's flux: A methods, F fluxes, R realisations of the air."""

    WHAT: ClassVar[str] = "a magnitude experiment"
    FORMAT: ClassVar[int] = 4

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.loop.simulation.Method.named`."""
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
        level: magnitude_gain(
            result.magnitudes, result.strehl[method], result.strehl[reference], level
        ).estimate
        for level in _STREHL_LEVELS
        if len(finite) and finite.min() < level <= finite.max()
    }
