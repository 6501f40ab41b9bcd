"""Curves of the slope error against signal, and the flux that a method saves, with confidence intervals.

A curve is one configuration (all parameters of a cell but its flux) in one mode, of its finished cells.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import number_between
from faintspot.errors import InputError
from faintspot.study.metric import magnitudes

if TYPE_CHECKING:
    import xarray

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
_RESAMPLES = 400
_GRID_POINTS = 1000  # over two to three decades of flux: the gain is exact to 0.1 %
_SMALLEST_ERROR_PX = 1e-6  # of a resampled R


@dataclass(frozen=True, order=True)
class Configuration:
    """All parameters of a cell but its flux; units as in the dataset."""

    profile: str
    position_range_px: float
    read_noise_e: float
    size: float
    elongation: float
    pixels: int
    background_e: float = 0.0
    em_gain: float = 1.0
    d_over_r0: float = 0.0

    @property
    def prior_error_px(self) -> float:
        """R of an estimator that always answers the centre: half of the range."""
        return self.position_range_px / 2

    def in_words(self) -> str:
        """Return the configuration in one line."""
        words = [
            f"{self.profile} spot of size {self.size:g}",
            f"{self.read_noise_e:g} e- read noise",
            f"{self.pixels} × {self.pixels} px",
            f"±{self.position_range_px:g} px",
        ]
        if self.elongation != 1:
            words.insert(1, f"elongated {self.elongation:g} times")
        if self.background_e:
            words.append(f"background {self.background_e:g} e-/px")
        if self.em_gain != 1:
            words.append(f"EM gain {self.em_gain:g}")
        if self.d_over_r0:
            words.append(f"d/r0 {self.d_over_r0:g}")
        return ", ".join(words)


@dataclass(frozen=True)
class Curve:
    """The scored slope error R of all arms at increasing flux, px."""

    configuration: Configuration
    flux_e: Floats
    arms: tuple[str, ...]
    error: Floats
    """(n_flux, n_arms)."""
    error_se: Floats
    covariance: Floats
    """(n_flux, n_arms, n_arms) of the means, px^2."""

    def of(self, arm: str) -> Floats:
        """Return R of an arm, (n_flux,)."""
        return self.error[:, self._index(arm)]

    def se_of(self, arm: str) -> Floats:
        """Return the standard error of R of an arm."""
        return self.error_se[:, self._index(arm)]

    def has(self, *arms: str) -> bool:
        """Whether these arms are in the study."""
        return all(arm in self.arms for arm in arms)

    def difference(self, arm: str, reference: str) -> tuple[Floats, Floats]:
        """Return R of `reference` minus R of `arm` at each flux and its paired standard error."""
        i, j = self._index(arm), self._index(reference)
        covariance = self.covariance
        variance = covariance[:, i, i] + covariance[:, j, j] - 2 * covariance[:, i, j]
        return self.error[:, j] - self.error[:, i], np.sqrt(np.maximum(variance, 0.0))

    def at(self, flux_e: float, arm: str) -> tuple[float, float] | None:
        """Return R and its standard error in the cell of that flux; None when there is none."""
        found = np.flatnonzero(np.isclose(self.flux_e, flux_e) & np.isfinite(self.of(arm)))
        return (float(self.of(arm)[found[0]]), float(self.se_of(arm)[found[0]])) if found.size else None

    def _index(self, arm: str) -> int:
        if arm not in self.arms:
            raise InputError(f"arm {arm!r}: expected one of {', '.join(self.arms)}")
        return self.arms.index(arm)


@dataclass(frozen=True)
class Gain:
    """By what factor less light a method reaches the same R, with its confidence interval."""

    factor: float
    """inf: the method's R is smaller than that at the lowest flux of the study; 0: it never gets there."""
    low: float
    high: float
    log_samples: Floats
    """Natural logarithm of the bootstrap's factors."""

    @property
    def magnitudes(self) -> tuple[float, float, float]:
        """The gain and its interval in magnitudes."""
        with np.errstate(divide="ignore"):
            return magnitudes(self.factor), magnitudes(self.low), magnitudes(self.high)

    @property
    def is_bounded(self) -> bool:
        """Whether the method's flux is within the study; below its lowest one, no upper end is known."""
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


def study_curves(dataset: xarray.Dataset, mode: str) -> dict[Configuration, Curve]:
    """Return the curve of every configuration in a mode, from the finished cells of a study.

    Raises
    ------
    InputError
        For a mode that the study does not have.
    """
    modes = [str(name) for name in dataset["mode"].values]
    if mode not in modes:
        raise InputError(f"mode {mode!r}: expected one of {', '.join(modes)}")
    arms = tuple(str(name) for name in dataset["arm"].values)
    of_mode = dataset[["error", "error_se", "error_covariance"]].sel(mode=mode)
    error = of_mode["error"].transpose("cell", "arm").values
    error_se = of_mode["error_se"].transpose("cell", "arm").values
    covariance = of_mode["error_covariance"].transpose("cell", "arm", "arm2").values
    flux = np.asarray(dataset["flux_e"].values, dtype=np.float64)
    return {
        configuration: Curve(
            configuration, flux[cells], arms, error[cells], error_se[cells], covariance[cells]
        )
        for configuration, cells in cells_by_configuration(dataset).items()
    }


def cells_by_configuration(dataset: xarray.Dataset) -> dict[Configuration, NDArray[np.int64]]:
    """Return the indices of the finished cells of every configuration, by increasing flux."""
    columns = {field.name: dataset[field.name].values for field in fields(Configuration)}
    found: dict[Configuration, list[int]] = {}
    for cell in np.flatnonzero(dataset["done"].values):
        values: dict[str, Any] = {name: column[cell].item() for name, column in columns.items()}
        found.setdefault(Configuration(**values), []).append(int(cell))
    flux = dataset["flux_e"].values
    return {key: np.array(sorted(cells, key=lambda cell: flux[cell])) for key, cells in found.items()}


def gain_at_flux(
    curve: Curve,
    flux_e: float,
    rng: np.random.Generator,
    *,
    method: str = "tv",
    reference: str = "plain",
) -> Gain | None:
    """Return by how much less light `method` reaches the R that `reference` has at a flux.

    log R is interpolated monotonically (PCHIP) in log flux. The 95 % interval is a parametric bootstrap: R of
    both arms is drawn from the normal distribution of their standard errors and covariance.

    Returns
    -------
    Gain or None
        None when the flux is outside the curve or a curve has fewer than two points.

    Raises
    ------
    InputError
        For a flux that is not above 0 or an unknown arm.
    """
    flux_e = number_between("flux_e", flux_e, 0.0, low_open=True)
    curves = _resampled(curve, reference, method, rng)
    if curves is None or not curves.log_flux[0] - 1e-9 <= np.log(flux_e) <= curves.log_flux[-1] + 1e-9:
        return None
    place = np.clip(np.log(flux_e), curves.log_flux[0], curves.log_flux[-1])
    wanted = _values_at(curves, curves.reference, place)
    return _gain(place - _crossings(curves, curves.method, wanted))


def gain_at_error(
    curve: Curve,
    error_px: float,
    rng: np.random.Generator,
    *,
    method: str = "tv",
    reference: str = "plain",
) -> Gain | None:
    """Return by how much less light `method` reaches a given R than `reference`; see `gain_at_flux`.

    Returns
    -------
    Gain or None
        None when `reference` does not have that R within the curve, or a curve has fewer than two points.

    Raises
    ------
    InputError
        For an error that is not above 0 or an unknown arm.
    """
    error_px = number_between("error_px", error_px, 0.0, low_open=True)
    curves = _resampled(curve, reference, method, rng)
    if curves is None:
        return None
    wanted = np.full(curves.reference.shape[1], np.log(error_px))
    needed = _crossings(curves, curves.reference, wanted)
    if not np.isfinite(needed[0]):
        return None
    known = np.isfinite(needed)  # resamples in which the reference just misses that error
    return _gain(needed[known] - _crossings(curves, curves.method, wanted)[known])


@dataclass(frozen=True)
class _Resampled:
    """Falling curves of log R on a fine grid of log flux, (grid, 1 + resamples); the first as measured."""

    log_flux: Floats
    reference: Floats
    method: Floats


def _resampled(curve: Curve, reference: str, method: str, rng: np.random.Generator) -> _Resampled | None:
    from scipy.interpolate import PchipInterpolator

    pair = [curve.arms.index(arm) for arm in (reference, method) if curve.has(arm)]
    if len(pair) < 2:
        raise InputError(f"arms {reference!r} and {method!r}: expected two of {', '.join(curve.arms)}")
    kept = np.all(np.isfinite(curve.error[:, pair]), axis=1)
    if np.count_nonzero(kept) < 2:
        return None
    error = curve.error[kept][:, pair]
    covariance = curve.covariance[kept][:, pair][:, :, pair]
    variances, axes = np.linalg.eigh(covariance)
    normal = rng.standard_normal((_RESAMPLES, *error.shape))
    drawn = error + np.einsum("fij,fj,sfj->sfi", axes, np.sqrt(np.maximum(variances, 0.0)), normal)
    every = np.maximum(np.concatenate([error[None], drawn]), _SMALLEST_ERROR_PX)
    # Made to fall: where noise makes a curve rise, by 1e-9, far below any error of R.
    falling = np.minimum.accumulate(np.log(every), axis=1) - 1e-9 * np.arange(error.shape[0])[:, None]
    knots = np.log(curve.flux_e[kept])
    grid = np.linspace(knots[0], knots[-1], _GRID_POINTS)
    values = PchipInterpolator(knots, falling, axis=1)(grid)
    return _Resampled(grid, values[:, :, 0].T, values[:, :, 1].T)


def _values_at(curves: _Resampled, values: Floats, place: float) -> Floats:
    """Return every curve's log R at a log flux."""
    step = curves.log_flux[1] - curves.log_flux[0]
    position = (place - curves.log_flux[0]) / step
    below = min(int(position), len(curves.log_flux) - 2)
    weight = position - below
    result: Floats = (1 - weight) * values[below] + weight * values[below + 1]
    return result


def _crossings(curves: _Resampled, values: Floats, wanted: Floats) -> Floats:
    """Return the log flux where each falling curve has its wanted value: -inf below the curve, inf beyond."""
    above = np.count_nonzero(values > wanted, axis=0)
    index = np.clip(above, 1, len(values) - 1)
    columns = np.arange(values.shape[1])
    before, after = values[index - 1, columns], values[index, columns]
    step = curves.log_flux[1] - curves.log_flux[0]
    place = curves.log_flux[index - 1] + step * (before - wanted) / (before - after)
    tolerance = 1e-9
    place = np.where((above == 0) & (wanted > values[0] + tolerance), -np.inf, place)
    return np.where((above == len(values)) & (wanted < values[-1] - tolerance), np.inf, place)


def _gain(log_factors: Floats) -> Gain:
    tail = 50 * (1 - CONFIDENCE)
    # "nearest" never averages with an infinite sample.
    low, high = np.percentile(log_factors[1:], [tail, 100 - tail], method="nearest")
    return Gain(float(np.exp(log_factors[0])), float(np.exp(low)), float(np.exp(high)), log_factors[1:])


def _factor(value: float) -> str:
    if value == 0:
        return "less than any measured"
    return "more than any measured" if np.isinf(value) else f"{value:.2f}"
