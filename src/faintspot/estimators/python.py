"""Estimators in plain NumPy: images are calibrated by the compiled kernel, positions found in Python."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.estimators.base import Estimator, Positions, Prepared
from faintspot.estimators.gravity import keep_all
from faintspot.estimators.sensor import Sensor
from faintspot.flags import INVALID, SubapertureFlag
from faintspot.kernels import gravity, groups
from faintspot.kernels.groups import SlopeArrays

_NO_LIGHT = np.uint8(SubapertureFlag.NO_LIGHT)
_AT_SEARCH_LIMIT = np.uint8(SubapertureFlag.AT_SEARCH_LIMIT)


def limit_slopes(away: NDArray[Any], table: NDArray[np.float32], flags: NDArray[np.uint8]) -> NDArray[Any]:
    """Return slopes (n, 2) within the search range; flags (n,) say which valid ones it has limited."""
    reach = table[groups.RANGE]
    at_limit = np.abs(away).max(axis=1) >= reach - groups.LIMIT_ROUNDING_PX
    flags &= ~_AT_SEARCH_LIMIT
    flags[at_limit & (flags & INVALID == 0)] |= _AT_SEARCH_LIMIT
    slopes: NDArray[Any] = np.clip(away, -reach[:, None], reach[:, None])
    return slopes


class PythonPrepared(Prepared):
    """The kernel calibrates images and flags what is bad; `locate` then finds the positions.

    Parameters
    ----------
    estimator : Estimator
        With a `locate` of its own.
    sensor : Sensor
    """

    kernel = staticmethod(gravity.gravity_of_groups)
    setting_rows = gravity.SETTING_ROWS

    def __init__(self, estimator: Estimator, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        if type(estimator).locate is Estimator.locate:
            raise InputError(
                f"estimator {estimator.name!r}: expected a class with `locate` or `prepared`, got neither"
            )

    @property
    def tables(self) -> Any:
        """See `Prepared`."""
        return gravity.GravityTables()

    @property
    def own_scratch(self) -> Any:
        """See `Prepared`."""
        return gravity.gravity_scratch

    def fill_light(self, table: NDArray[np.float32], flux_e: NDArray[np.float64]) -> None:
        """See `Prepared`."""
        keep_all(table)

    def positions(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the positions (n, 2) of the spots of one frame, px from the windows' middles."""
        found = self._found(images, self.sensor.zero)
        return np.stack([found.x, found.y], axis=1).astype(np.float32)

    def _found(self, images: NDArray[np.float32], prior: NDArray[np.floating[Any]]) -> Positions:
        """Return what the estimator finds, checked."""
        found = self.estimator.locate(images, self.sensor, prior.astype(np.float64))
        if isinstance(found, Positions):
            return found
        array, n = np.asarray(found), self.sensor.n
        if array.shape != (n, 2):
            raise InputError(
                f"estimator {self.estimator.name!r}: locate: expected ({n}, 2), got {array.shape}"
            )
        return Positions(array[:, 0], array[:, 1])

    def locate_frame(
        self,
        images: NDArray[np.float32],
        prior: NDArray[np.float32],
        table: NDArray[np.float32],
        frame: int,
        slopes: SlopeArrays,
    ) -> None:
        """Write the slopes of one frame; flags hold what the calibration has found.

        Parameters
        ----------
        images : (n, ny, nx) float32
        prior : (2, n) float32
            Predicted slopes, px from the reference.
        table : (rows, n) float32
            Of settings.
        frame : int
            Number of the frame in `slopes`.
        slopes : SlopeArrays

        Raises
        ------
        InputError
            When the estimator returns something of another shape.
        """
        sensor, n = self.sensor, self.sensor.n
        found = self._found(images, sensor.zero + prior.T)
        light = images.sum(axis=(1, 2)) if found.flux is None else found.flux
        usable = np.isfinite(found.x) & np.isfinite(found.y) & np.isfinite(light)
        usable &= np.ones(n, bool) if found.valid is None else np.asarray(found.valid, bool)
        flags = slopes.flags[frame]
        flags &= ~_NO_LIGHT
        flags[~usable & (flags & INVALID == 0)] |= _NO_LIGHT
        valid = (flags & INVALID) == 0
        slopes.flux[frame] = np.where(usable, light, 0.0)
        positions = np.stack([found.x, found.y], axis=1)
        away = np.where(valid[:, None], positions - sensor.zero, 0.0)
        slopes.x[frame], slopes.y[frame] = limit_slopes(away, table, flags).T
        scale = table[groups.ERROR_SCALE]
        errors = found.standard_error_x, found.standard_error_y
        for error, result in zip(errors, (slopes.standard_error_x, slopes.standard_error_y), strict=True):
            result[frame] = np.inf if error is None else np.where(valid, scale * error, np.inf)
