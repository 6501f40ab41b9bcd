"""Slopes that are linear in the pixels, by a fixed Gaussian window or any fixed weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.base.options import Value, option
from faintspot.base.statistics import FWHM_TO_STD
from faintspot.slopes.estimators.base import Estimator, EstimatorPlan, Need, Style
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene, Sensor
from faintspot.slopes.estimators.spot_tables import gaussian_psf
from faintspot.slopes.kernels.groups import RANGE
from faintspot.slopes.kernels.host import WIDTHS, lanes_for
from faintspot.slopes.kernels.positions import window
from faintspot.slopes.spots.fixed_weights import FixedWeights

_WIDTHS = (1.25, 0.8, 1.0, 1.6, 2.0, 2.8)  # multiples of the spot's width
_WIDTHS_OF_SPECKLES = (2.0, 1.0, 1.25, 1.6, 2.8, 4.0)
_LEAST_WEIGHT = 1e-4  # relative to the window's centre; pixels with smaller weights are not read
_STEP_PX = 0.25  # displacement of the spot from which the gain is computed
_SMALLEST_GAIN = 0.02
_LEAST_FLUX = 1e-6  # relative to the brightest spot
MEAN, FRAME, NONE = "mean", "frame", "none"


class _WindowPlan(EstimatorPlan):
    """Weights of each sub-aperture and the tables derived from them."""

    setting_rows = window.SETTING_ROWS
    rows_of_options: Mapping[str, int] = MappingProxyType({"search_range_px": RANGE})
    own_scratch = staticmethod(window.no_scratch)

    estimator: Window

    @property
    def kernel(self) -> Any:
        """See `EstimatorPlan`."""
        return window.window_of_groups if self._columns is None else window.window_in_rows

    @cached_property
    def weights(self) -> FixedWeights:
        """Weights given to the pipeline, or those of the Gaussian windows."""
        given, sensor = self.sensor.weights, self.sensor
        if not isinstance(given, FixedWeights):
            return self._gaussian()
        gain, region = self.each("centroid_gain"), self._half_regions()
        if np.isnan(gain).all() and region.min() > max(sensor.window):
            return given
        kinds, gain = given.index_of(sensor.n), np.nan_to_num(gain, nan=1.0)[:, None, None]
        inside = ~_outside(*_offsets(sensor.layout.offsets, sensor.window), region)
        x, y, spot, flux = (maps[kinds] for maps in (given.x, given.y, given.mean_spot, given.flux))
        return FixedWeights(inside * x / gain, inside * y / gain, spot, inside * flux, np.arange(sensor.n))

    def _gaussian(self) -> FixedWeights:
        """Compute Gaussian windows at the reference positions."""
        sensor = self.sensor
        gain, region = np.nan_to_num(self.each("centroid_gain")), self._half_regions()
        planes = np.zeros(sensor.n) if sensor.psf is None else sensor.psf.index_of(sensor.n)
        parts = [sensor.zero, self._window_std_px(), sensor.spot_fwhm_px, planes, gain, region]
        kinds, index = np.unique(np.column_stack(parts), axis=0, return_inverse=True)
        zero, std, own = kinds[:, :2], kinds[:, 2:4], kinds[:, 7]
        spots = gaussian_psf(kinds[:, 4:6]) if sensor.psf is None else sensor.psf
        which = np.arange(len(kinds)) if sensor.psf is None else kinds[:, 6].astype(np.int64)
        u, v = _offsets(zero, sensor.window)
        weight = np.exp(-0.5 * ((u / std[:, :1, None]) ** 2 + (v / std[:, 1:, None]) ** 2))
        weight[(weight < _LEAST_WEIGHT) | _outside(u, v, kinds[:, 8])] = 0.0
        maps = [weight * u, weight * v]
        for axis in range(2):
            seen = own
            if not own.all():
                step = np.eye(2)[axis] * _STEP_PX
                ahead, behind = (spots.images(zero + d, sensor.window, which=which) for d in (step, -step))
                slope = (maps[axis] * (ahead - behind)).sum(axis=(1, 2)) / (2 * _STEP_PX)
                seen = np.where(own > 0, own, np.maximum(slope, _SMALLEST_GAIN))
            maps[axis] = maps[axis] / seen[:, None, None]
        at_reference = spots.images(zero, sensor.window, which=which)
        seen = np.maximum((weight * at_reference).sum(axis=(1, 2)), _SMALLEST_GAIN)
        return FixedWeights(maps[0], maps[1], at_reference, weight / seen[:, None, None], index.reshape(-1))

    def _window_std_px(self) -> Floats:
        """Return the standard deviations of the windows along x and y, (n, 2)."""
        spot = self.sensor.spot_fwhm_px
        factor = self.each("window_fwhm_px") / np.sqrt(spot.prod(axis=1))
        std: Floats = FWHM_TO_STD * spot * np.where(np.isnan(factor), 1.0, factor)[:, None]
        return std

    def _half_regions(self) -> Floats:
        """Return half the side of the region that is used, (n,) px."""
        half: Floats = np.minimum(0.5 * np.nan_to_num(self.each("region_px"), nan=np.inf), 1e3)
        return half

    @cached_property
    def _maps(self) -> Floats:
        """Return the weights of each kind, (n_kinds, ny, nx, 3)."""
        weights = self.weights
        return np.stack([weights.x, weights.y, weights.flux], axis=-1)

    @cached_property
    def _region(self) -> tuple[int, int, int, int]:
        """Return the first row and column of the pixels used, and those after the last ones."""
        counted = np.argwhere(self._maps.any(axis=(0, 3)))
        counted = counted if len(counted) else np.zeros((1, 2), np.int64)
        (top, left), (bottom, right) = counted.min(axis=0), counted.max(axis=0) + 1
        return int(top), int(left), int(bottom), int(right)

    @cached_property
    def _columns(self) -> tuple[int, int, int] | None:
        """Return SIMD width, first column and number of columns of whole vectors in the window, or None."""
        _, left, _, right = self._region
        side, found = self.sensor.window[1], []
        # Width of the machine, not of the pipeline: the order of a sum depends on it.
        for width in (width for width in WIDTHS if width <= lanes_for(np.float32).width):
            columns = -(-(right - left) // width) * width
            if columns <= side:
                found.append((columns // width, width, min(left, side - columns), columns))
        return min(found)[1:] if found else None

    @cached_property
    def tables(self) -> window.WindowTables | window.RowTables:
        """See `EstimatorPlan`."""
        sensor, kinds = self.sensor, self.weights.index_of(self.sensor.n)
        top, left, bottom, right = self._region
        n_groups = -(-sensor.n // sensor.width)
        lanes = np.minimum(np.arange(n_groups * sensor.width), sensor.n - 1)
        packed = self._maps[kinds[lanes], top:bottom, left:right]
        packed = packed.reshape(n_groups, sensor.width, *packed.shape[1:]).transpose(0, 2, 3, 4, 1)
        packed = np.ascontiguousarray(packed, np.float32)
        whole = window.WindowTables(packed, top, left, bottom - top, right - left)
        if self._columns is None:
            return whole
        return self._row_tables(whole)

    def _row_tables(self, whole: window.WindowTables) -> window.RowTables:
        """Return the tables of `window_in_rows`: weights times gain, and the contribution of the dark."""
        sensor, (width, left, columns) = self.sensor, not_none(self._columns)
        top, bottom = whole.top, whole.top + whole.rows
        maps = sensor.layout.images(sensor.calibration.maps(sensor.layout.frame_shape))
        dark, scale = maps[:, :, top:bottom, left : left + columns]
        weights = self._maps[self.weights.index_of(sensor.n), top:bottom, left : left + columns]
        counted = weights.any(axis=-1)
        bad = (counted & ~np.isfinite(scale)).any(axis=(1, 2))
        scale, dark = np.where(counted & ~bad[:, None, None], (scale, dark), 0.0)
        level = dark.sum(axis=(1, 2)) / np.maximum(counted.sum(axis=(1, 2)), 1)
        weights = (weights * scale[..., None]).astype(np.float32)
        above = np.where(counted, dark - level[:, None, None], 0.0)
        packed = weights.reshape(sensor.n, bottom - top, columns // width, width, 3).swapaxes(3, 4)
        return window.RowTables(
            lanes_for(np.float32, width),
            np.ascontiguousarray(packed),
            level.astype(np.float32),
            (weights * above[..., None]).sum(axis=(1, 2)).astype(np.float32),
            bad,
            top,
            left,
            whole,
        )

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        weights, sensor = self.weights, self.sensor
        kinds = weights.index_of(sensor.n)
        fixed = isinstance(sensor.weights, FixedWeights)
        table[window.HOME_X], table[window.HOME_Y] = (sensor.layout.offsets if fixed else sensor.zero).T
        photons = sensor.excess_noise * np.maximum(weights.mean_spot, 0.0)
        rows = zip(
            (window.DARK_X, window.DARK_Y, window.DARK_FLUX, window.DARK_XY),
            (window.PHOTON_X, window.PHOTON_Y, window.PHOTON_FLUX, window.PHOTON_XY),
            (*map(np.square, (weights.x, weights.y, weights.flux)), weights.x * weights.y),
            strict=True,
        )
        for dark, photon, products in rows:
            table[dark] = (self.pixel_variance * products[kinds]).sum(axis=(1, 2))
            table[photon] = (photons * products).sum(axis=(1, 2))[kinds]

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        weights, how = self.weights, self.estimator.normalisation
        kinds = weights.index_of(self.sensor.n)
        offsets = [(maps * weights.mean_spot).sum(axis=(1, 2))[kinds] for maps in (weights.x, weights.y)]
        if how == NONE:
            table[window.DIVISOR], offsets = 1.0, [np.zeros(1), np.zeros(1)]
        elif how == FRAME:
            table[window.DIVISOR] = 0.0
        else:
            # A known flux of 0 means no spot; where the flux is unknown, the frame's own flux is used.
            illuminated = np.where(flux_e > _LEAST_FLUX * np.nan_to_num(flux_e).max(), flux_e, -1.0)
            table[window.DIVISOR] = np.where(np.isnan(flux_e), 0.0, illuminated)
        table[window.OFFSET_X], table[window.OFFSET_Y] = offsets


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Window(Estimator):
    """Centre of gravity with a fixed window, divided by its mean flux and its gain (Nicolle et al. 2004)."""

    window_fwhm_px: Value = option(
        None,
        "Full width at half maximum of the Gaussian window at the reference position, geometric mean of "
        "both axes; the window has the elongation of the spot. Default: the width of the spot. Replaced by"
        " the fixed weights of the pipeline, if given.",
        unit="px",
        low=0.1,
        high=1e3,
    )
    region_px: Value = option(
        None,
        "Side of the square of pixels around the reference position that is used; bad or saturated pixels "
        "elsewhere have no effect. Default: the whole sub-aperture.",
        unit="px",
        low=0.0,
        high=64.0,
        low_open=True,
    )
    normalisation: Value = option(
        None,
        'Normalisation of the sums. "mean": expected flux (`flux_e`, or a running mean); "frame": flux of '
        'the frame within the window; "none": no normalisation. Default: "mean" if the flux is known, '
        'otherwise "frame".',
        choices=(MEAN, FRAME, NONE),
        per_subaperture=False,
    )
    centroid_gain: Value = option(
        None,
        "Centroid gain: slope measured for a displacement of 1 px; slopes are divided by it. Default: that"
        " of the spot near the reference position.",
        low=0.0,
        high=100.0,
        low_open=True,
    )

    name = "window"
    label = "fixed window"
    method = "centre of gravity with a fixed window, divided by its mean flux and gain"
    needs = frozenset({Need.WIDTH})
    cost = 0.08
    style = Style("#8C510A", "-", "p")
    plan = _WindowPlan

    @property
    def uses_flux(self) -> bool:
        """See `Estimator`."""
        return self.normalisation in (None, MEAN)

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[Any]]:
        """Return widths around that of the spot; wider ones for speckled spots."""
        factors = _WIDTHS_OF_SPECKLES if scene.d_over_r0 > 1 else _WIDTHS
        return {"window_fwhm_px": [factor * scene.seen_fwhm_px for factor in factors]}

    def for_bright_flux(self) -> Window:
        """Normalise by the flux of the frame."""
        return self.replaced({"normalisation": FRAME}) if self.uses_flux else self

    def check(self, sensor: Sensor) -> None:
        """See `Estimator`."""
        weights = sensor.weights
        if isinstance(weights, FixedWeights):
            if weights.window != sensor.window:
                wanted, got = (f"{ny} x {nx}" for ny, nx in (sensor.window, weights.window))
                raise InputError(f"weights: expected windows of {wanted} px as in the layout, got {got}")
            weights.index_of(sensor.n)
        else:
            super().check(sensor)
        if self.normalisation == MEAN and np.isnan(sensor.flux_e).any():
            raise InputError(
                f"settings.flux_e: expected the flux of the spots (electrons) for estimator {self.name!r} "
                'with normalisation "mean", got none'
            )


def _offsets(middles: Floats, window_px: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return the offsets of pixels from `middles` (n, 2) in the window: (n, 1, nx) and (n, ny, 1) px."""
    v, u = (np.arange(side) - 0.5 * (side - 1) for side in window_px)
    return u - middles[:, :1, None], v[:, None] - middles[:, 1:, None]


def _outside(u: Floats, v: Floats, half: Floats) -> NDArray[np.bool_]:
    """Return which pixels are more than half a side away from the middles."""
    away: NDArray[np.bool_] = np.maximum(np.abs(u), np.abs(v)) >= half[:, None, None]
    return away
