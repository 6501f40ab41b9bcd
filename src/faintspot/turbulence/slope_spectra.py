"""Cross-spectra of slopes in frozen turbulence, including the window of the Fourier transform.

For a layer with wind v, slopes of sub-apertures b apart have the covariance cov(b - v t) after a time t.
Its windowed transform is exact, including leakage. Covariances are tabulated, finely near the origin and
coarsely far from it, for some outer scales, and interpolated in the logarithm of the outer scale.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import map_coordinates, spline_filter

from faintspot.turbulence.slope_covariance import SlopeTurbulence, gradient_covariances

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

_FIRST_LOG_SCALE, _LOG_SCALE_STEP, _SCALES = math.log(2.0), math.log(1.25), 22  # of outer scales, m
_SPACING = 0.1  # of the table's grid, asinh(separation / side of a sub-aperture)


class SlopeSpectra:
    """Cross-spectra of the slopes of a sensor at selected frequencies.

    Only distinct separations of sub-apertures are computed: rows of "distinct" spectra are xx, xy and yy
    for each of them; opposite separations have the complex conjugates.

    Parameters
    ----------
    site : SlopeTurbulence
        Positions, sub-aperture and pixel scale are used; strength, outer scale and winds are not.
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
        apart = np.round((site.positions_m[:, None] - site.positions_m).reshape(-1, 2), 6)
        is_opposite = (apart[:, 0] < 0) | ((apart[:, 0] == 0) & (apart[:, 1] < 0))
        self._apart_m, which = np.unique(
            np.where(is_opposite[:, None], -apart, apart), axis=0, return_inverse=True
        )
        self._index(which.reshape(-1), is_opposite)
        largest = float(np.abs(self._apart_m).max(initial=0.0)) + reach_m
        self._known: dict[int, Floats] = {}
        self._nodes = math.ceil(math.asinh(largest / self._side) / _SPACING) + 2

    def _index(self, which: NDArray[np.int64], is_opposite: NDArray[np.bool_]) -> None:
        n, distinct = len(self._site.positions_m), len(self._apart_m)
        which = which.reshape(n, n)
        cross = which + distinct
        self._which = np.block([[which, cross], [cross, which + 2 * distinct]])
        self._opposite = np.tile(is_opposite.reshape(n, n), (2, 2))
        entries = 4 * n * n
        self._sum = sparse.csr_matrix(
            (np.ones(entries), (self._which.ravel(), np.arange(entries))), shape=(3 * distinct, entries)
        )

    def tables(self, outer_scale_m: float) -> tuple[Floats, Floats]:
        """Return tables of the covariances xx, xy and yy of turbulence with r0 = 1 m, and their derivatives.

        The derivative is with respect to the logarithm of the outer scale.
        """
        place = (math.log(outer_scale_m) - _FIRST_LOG_SCALE) / _LOG_SCALE_STEP
        node = int(min(max(math.floor(place), 0), _SCALES - 2))
        low, high = self._table(node), self._table(node + 1)
        return low + (place - node) * (high - low), (high - low) / _LOG_SCALE_STEP

    def _table(self, node: int) -> Floats:
        """Return spline coefficients (3, places, places) for one of the outer scales."""
        if node not in self._known:
            place = self._side * np.sinh(_SPACING * np.arange(self._nodes))
            x, y = (each.ravel() for each in np.meshgrid(place, place, indexing="ij"))
            scale_m = math.exp(_FIRST_LOG_SCALE + node * _LOG_SCALE_STEP)
            tables = gradient_covariances(x, y, self._side, scale_m) * self._site.px2_per_rad2_per_m2
            even, odd = (each.reshape(self._nodes, -1) for each in tables[:2])
            quarters = (even, 1), (odd, -1), (even.T, 1)
            self._known[node] = np.array([spline_filter(_four_quarters(*each), order=3) for each in quarters])
        return self._known[node]

    def of_wind(self, wind_m_per_s: Floats, tables: Floats) -> Complex:
        """Return the distinct spectra (frequencies, 3 distinct) px^2 of a layer of r0 = 1 m."""
        shift = self._later_s[:, None, None] * np.asarray(wind_m_per_s)
        apart = (self._apart_m - shift).transpose(2, 0, 1)
        place = np.arcsinh(apart / self._side) / _SPACING + (self._nodes - 1)
        covariances = [
            map_coordinates(table, place, order=3, prefilter=False, mode="nearest") for table in tables
        ]
        return np.asarray(self._transform @ np.concatenate(covariances, axis=1))

    def of_process(self, covariance_px2: Floats) -> Complex:
        """Return the spectrum (frequencies,) of one record with covariances for lags of 0, 1, ... steps."""
        both = np.concatenate([covariance_px2[:0:-1], covariance_px2])
        return np.asarray(self._transform @ both)

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


def _four_quarters(quarter: Floats, sign: int) -> Floats:
    """Return a table over both signs of both coordinates, even or odd in each."""
    half = np.concatenate([sign * quarter[:0:-1], quarter])
    return np.concatenate([sign * half[:, :0:-1], half], axis=1)
