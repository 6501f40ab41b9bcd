"""Cross-spectra of slopes in frozen turbulence, and open-loop slopes prepared for spectra.

For a layer with wind v, slopes of sub-apertures b apart have the covariance cov(b - v t) after a time t.
Its windowed transform is exact, including leakage. Covariances are tabulated, finely near the origin and
coarsely far from it, for some outer scales, and interpolated in the logarithm of the outer scale.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import spline_filter

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.vibrations import mode_shapes
from faintspot.loop.slope_covariance import SlopeTurbulence, gradient_covariances
from faintspot.slopes.kernels.compiling import compiled_with

_MOST_SUBAPERTURES = 60
_LEAST_MEASURED, _LEAST_MEASURED_OF_WINDOW = 0.5, 0.8  # of frames, or of slopes
_MOST_VARIANCE = 4.0  # of the median: slopes with more count as not measured. More of them hide weak layers


@dataclass(frozen=True, eq=False)
class SlopeRecords:
    """Slopes of the sub-apertures that were measured, without gaps."""

    site: SlopeTurbulence
    slopes: Floats
    """(frames, m): interpolated in time where not measured, without their mean."""
    noise_px2: Floats
    """(m,): mean variance of the noise according to the standard errors."""
    measured: NDArray[np.bool_]
    """(frames,): whether most of the slopes were measured."""

    @classmethod
    def of(
        cls, telemetry: OpenLoopTelemetry, site: SlopeTurbulence, most: int = _MOST_SUBAPERTURES
    ) -> SlopeRecords:
        """Prepare telemetry of a sensor.

        Parameters
        ----------
        telemetry : OpenLoopTelemetry
        site : SlopeTurbulence
        most : int
            Largest number of sub-apertures; of more, some are left out evenly. A model that knows which ones
            these are can do without the others. Sums over those alone are no modes of the sensor: waves
            as long as their distance add up.

        Raises
        ------
        InputError
            When no sub-aperture was measured in half of the frames.
        """
        variance = telemetry.variance_px2
        usual = np.median(np.where(np.isfinite(variance), variance, np.inf), axis=0)
        measured = variance <= _MOST_VARIANCE * usual
        measured &= np.isfinite(usual)
        n = len(site.positions_m)
        enough = measured.mean(axis=0).reshape(2, n).min(axis=0) >= _LEAST_MEASURED
        if not enough.any():
            raise InputError("telemetry: expected slopes that were measured in half of the frames, got none")
        kept = np.flatnonzero(enough)[:: math.ceil(np.count_nonzero(enough) / most)]
        columns = np.concatenate([kept, kept + n])
        slopes = interpolated(telemetry.open_loop_px[:, columns], measured[:, columns])
        counted = np.where(measured[:, columns], variance[:, columns], np.nan)
        return cls(
            replace(site, positions_m=site.positions_m[kept]),
            slopes - slopes.mean(axis=0),
            np.nanmean(counted, axis=0),
            measured[:, columns].mean(axis=1) >= _LEAST_MEASURED,
        )

    def modes(self) -> Floats:
        """Return amplitudes of tip, tilt and focus, (frames, 3)."""
        return self.slopes @ mode_shapes(self.site.positions_m).T

    def segments(self, every: int, length: int) -> Floats:
        """Return half-overlapping pieces (pieces, length, m) of every n-th frame."""
        pieces = []
        for first in range(every):
            slopes, measured = self.slopes[first::every], self.measured[first::every]
            for start in range(0, len(slopes) - length + 1, length // 2):
                piece = slice(start, start + length)
                if measured[piece].mean() >= _LEAST_MEASURED_OF_WINDOW:
                    pieces.append(slopes[piece])
        if not pieces:
            raise InputError(
                f"telemetry: expected {every * length} frames without a gap for its spectra, got "
                f"{len(self.slopes)} frames, {np.count_nonzero(self.measured)} of them measured"
            )
        return np.array(pieces)


def interpolated(values: Floats, measured: NDArray[np.bool_]) -> Floats:
    """Return values (frames, m), interpolated in time where not measured."""
    if measured.all():
        return values
    frames, result = np.arange(len(values)), values.copy()
    for slope, usable in enumerate(measured.T):
        result[~usable, slope] = np.interp(frames[~usable], frames[usable], values[usable, slope])
    return result


Complex = NDArray[np.complex128]

_FIRST_LOG_SCALE, _LOG_SCALE_STEP, _SCALES = math.log(2.0), math.log(1.25), 22  # of outer scales, m
_SPACING = 0.1  # of the table's grid, asinh(separation / side of a sub-aperture)
_AXES, _ORDERS, _POINTS = 2, 2, 4  # of cubic splines: x and y, values and derivatives, coefficients of each
_compiled = partial(compiled_with, source=__file__)


class SlopeSpectra:
    """Cross-spectra of the slopes of a sensor at selected frequencies.

    Only distinct separations of sub-apertures are computed: rows of "distinct" spectra are xx, xy and yy
    for each of them; opposite separations have the complex conjugates.

    Parameters
    ----------
    site : SlopeTurbulence
        Strength, outer scale and winds are not used.
    step_s : float
        Time between two values of a record.
    window : (length,) array
        Window by which the record was multiplied before its transform; the sum of squares is 1.
    bins : (frequencies,) array of int
        Bins of the transform, at frequencies bins / (length step_s).
    reach_m : float
        Largest shift by the wind within a window.
    """

    def __init__(
        self, site: SlopeTurbulence, step_s: float, window: Floats, bins: NDArray[np.int64], reach_m: float
    ) -> None:
        length = len(window)
        lags = np.arange(1 - length, length)
        self._later_s = lags * step_s
        self._transform = np.exp(-2j * np.pi / length * np.outer(bins, lags))
        self._transform *= np.correlate(window, window, "full")
        self._site, self._side = site, site.subaperture_m
        self._averaged_m = site.averaged * site.subaperture_m
        apart_m = np.round((site.positions_m[:, None] - site.positions_m).reshape(-1, 2), 6)
        is_opposite = (apart_m[:, 0] < 0) | ((apart_m[:, 0] == 0) & (apart_m[:, 1] < 0))
        self._apart_m, separation = np.unique(
            np.where(is_opposite[:, None], -apart_m, apart_m), axis=0, return_inverse=True
        )
        self._index(separation.reshape(-1), is_opposite)
        largest = float(np.abs(self._apart_m).max(initial=0.0)) + reach_m
        self._nodes = math.ceil(math.asinh(largest / self._side) / _SPACING) + 2

    def _index(self, separation: NDArray[np.int64], is_opposite: NDArray[np.bool_]) -> None:
        n, distinct = len(self._site.positions_m), len(self._apart_m)
        separation = separation.reshape(n, n)
        cross = separation + distinct
        self._which = np.block([[separation, cross], [cross, separation + 2 * distinct]])
        self._opposite = np.tile(is_opposite.reshape(n, n), (2, 2))
        entries = 4 * n * n
        self._sum = sparse.csr_matrix(
            (np.ones(entries), (self._which.ravel(), np.arange(entries))), shape=(3 * distinct, entries)
        )

    def averaging(self, averaged: float) -> SlopeSpectra:
        """Return the spectra of other `SlopeTurbulence.averaged`."""
        spectra = copy.copy(self)
        spectra._averaged_m = averaged * self._side
        return spectra

    def tables(self, outer_scale_m: float) -> tuple[Floats, Floats]:
        """Return tables of the covariances xx, xy and yy of turbulence with r0 = 1 m, and their derivatives.

        The derivative is with respect to the logarithm of the outer scale.
        """
        position = (math.log(outer_scale_m) - _FIRST_LOG_SCALE) / _LOG_SCALE_STEP
        node = int(min(max(math.floor(position), 0), _SCALES - 2))
        of_sensor = self._side, self._averaged_m, self._nodes
        low, high = (self._site.px2_per_rad2_per_m2 * _table(*of_sensor, index) for index in (node, node + 1))
        return low + (position - node) * (high - low), (high - low) / _LOG_SCALE_STEP

    def of_wind(self, wind_m_per_s: Floats, tables: Floats) -> Complex:
        """Return the distinct spectra (frequencies, 3 distinct) px^2 of a layer of r0 = 1 m."""
        return np.asarray(self._of_wind(wind_m_per_s, tables, 0)[0])

    def changes(self, wind_m_per_s: Floats, tables: Floats, slopes: Floats) -> Complex:
        """Return the spectra as `of_wind` and their derivatives, (4, frequencies, 3 distinct).

        Derivatives are those with respect to the wind along x and y (m/s), and to the logarithm of the outer
        scale. `slopes` are the derivatives from `tables`.
        """
        value, of_scale, *of_wind = self._of_wind(wind_m_per_s, np.concatenate([tables, slopes]), len(tables))
        return np.array([value, *of_wind, of_scale])

    def _of_wind(self, wind_m_per_s: Floats, tables: Floats, derived: int) -> Complex:
        """Return spectra (kinds, frequencies, 3 distinct) from tables in threes.

        The derivatives of the first `derived` ones with respect to the wind along x and y come last.
        """
        lags, distinct = len(self._later_s), len(self._apart_m)
        covariances = np.empty((lags, len(tables) + 2 * derived, distinct))
        shift_m, weights = self._later_s[:, None] * wind_m_per_s, np.empty((_AXES, _ORDERS, _POINTS))
        scale = self._side, _SPACING, self._nodes - 1
        _interpolate(self._apart_m, shift_m, scale, tables, derived, weights, covariances)
        covariances[:, len(tables) :] *= -self._later_s[:, None, None]
        flat = covariances.reshape(lags, -1)
        spectra = self._transform.real @ flat + 1j * (self._transform.imag @ flat)
        return np.asarray(spectra.reshape(len(spectra), -1, 3 * distinct).swapaxes(0, 1))

    def of_process(self, covariance_px2: Floats) -> Complex:
        """Return the spectrum (frequencies,) of one record with covariances for lags of 0, 1, ... steps."""
        symmetric = np.concatenate([covariance_px2[:0:-1], covariance_px2])
        return np.asarray(self._transform @ symmetric)

    def matrices(self, distinct: Complex) -> Complex:
        """Return the cross-spectra (frequencies, 2 n, 2 n) from the distinct ones."""
        full = distinct[:, self._which]
        np.conjugate(full, out=full, where=self._opposite)
        return full

    def summed(self, gradient: Complex) -> Complex:
        """Return s (frequencies, 3 distinct): Re sum(s d) = sum of tr(gradient matrices(d)) for all d."""
        turned = gradient.swapaxes(1, 2).copy()
        np.conjugate(turned, out=turned, where=self._opposite)
        return np.asarray((self._sum @ turned.reshape(len(turned), -1).T).T)


@lru_cache(maxsize=2 * _SCALES)
def _table(side_m: float, averaged_m: float, nodes: int, scale: int) -> Floats:
    """Return spline coefficients (3, places, places), rad^2 m^-2, for one of the outer scales."""
    positions_m = side_m * np.sinh(_SPACING * np.arange(nodes))
    x, y = (coordinate.ravel() for coordinate in np.meshgrid(positions_m, positions_m, indexing="ij"))
    tables = gradient_covariances(x, y, averaged_m, math.exp(_FIRST_LOG_SCALE + scale * _LOG_SCALE_STEP))
    even, odd = (table.reshape(nodes, -1) for table in tables[:2])
    quarters = (even, 1), (odd, -1), (even.T, 1)
    return np.array([spline_filter(_four_quarters(*quarter), order=3) for quarter in quarters])


def _four_quarters(quarter: Floats, sign: int) -> Floats:
    """Return a table over both signs of both coordinates, even or odd in each."""
    half = np.concatenate([sign * quarter[:0:-1], quarter])
    return np.concatenate([sign * half[:, :0:-1], half], axis=1)


@_compiled
def _interpolate(
    apart_m: Any, shift_m: Any, scale: Any, tables: Any, derived: Any, weights: Any, out: Any
) -> None:
    """Write tables at shifted separations by cubic splines, then derivatives [1/m] along x and along y.

    Parameters
    ----------
    apart_m : (distinct, 2) array
    shift_m : (lags, 2) array
    scale : (float, float, int)
        Side of a sub-aperture, spacing of the grid, place of the origin.
    tables : (k, places, places) array
        Spline coefficients.
    derived : int
        Number of tables whose derivatives are written.
    weights : (2, 2, 4) array
        Work array.
    out : (lags, k + 2 derived, distinct) array
    """
    side, spacing, origin = scale
    count, nodes = tables.shape[0], tables.shape[1]
    for lag in range(shift_m.shape[0]):
        for s in range(apart_m.shape[0]):
            row = _spline(apart_m[s, 0] - shift_m[lag, 0], side, spacing, origin, nodes, weights[0])
            column = _spline(apart_m[s, 1] - shift_m[lag, 1], side, spacing, origin, nodes, weights[1])
            of_x, of_y = weights[0], weights[1]
            for k in range(count):
                value, along, across = 0.0, 0.0, 0.0
                for i in range(_POINTS):
                    row_value, slope = 0.0, 0.0
                    for j in range(_POINTS):
                        row_value += of_y[0, j] * tables[k, row + i, column + j]
                        slope += of_y[1, j] * tables[k, row + i, column + j]
                    value += of_x[0, i] * row_value
                    along += of_x[1, i] * row_value
                    across += of_x[0, i] * slope
                out[lag, k, s] = value
                if k < derived:
                    out[lag, count + k, s] = along
                    out[lag, count + derived + k, s] = across


@_compiled
def _spline(apart_m: float, side: float, spacing: float, origin: int, nodes: int, weights: Floats) -> int:
    """Write weights and derivatives (2, 4) of coefficients at a separation; return the first one's place."""
    ratio = apart_m / side
    root = math.sqrt(1.0 + ratio * ratio)
    position = math.copysign(math.log(abs(ratio) + root), ratio) / spacing + origin
    position = min(max(position, 1.0), nodes - 2.001)
    first = int(position)
    t, per_m = position - first, 1.0 / (root * side * spacing)
    complement = 1.0 - t
    weights[0, 0], weights[0, 3] = complement * complement * complement / 6.0, t * t * t / 6.0
    weights[0, 1] = (4.0 - 3.0 * t * t * (1.0 + complement)) / 6.0
    weights[0, 2] = (4.0 - 3.0 * complement * complement * (1.0 + t)) / 6.0
    weights[1, 0], weights[1, 3] = -0.5 * complement * complement * per_m, 0.5 * t * t * per_m
    weights[1, 1] = t * (1.5 * t - 2.0) * per_m
    weights[1, 2] = -complement * (1.5 * complement - 2.0) * per_m
    return first - 1
