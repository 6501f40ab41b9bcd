"""Estimators in plain NumPy: the compiled kernel calibrates the images, Python finds the positions."""

import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import LARGEST_FLOAT32, check_shape, not_none
from faintspot.base.errors import InputError
from faintspot.base.flags import UNMEASURED, SubapertureFlag
from faintspot.slopes.estimators.base import Estimator, EstimatorPlan, Positions
from faintspot.slopes.estimators.built_in.gravity import keep_all
from faintspot.slopes.estimators.registry import faults_of
from faintspot.slopes.estimators.sensor import Sensor
from faintspot.slopes.kernels import groups
from faintspot.slopes.kernels.groups import SlopeArrays
from faintspot.slopes.kernels.positions import gravity

_NO_FLUX = np.uint8(SubapertureFlag.NO_FLUX)
_TYPICAL_FLUX_E = 300.0
_AT_SEARCH_LIMIT = np.uint8(SubapertureFlag.AT_SEARCH_LIMIT)


def _limited(
    away: NDArray[np.generic], table: NDArray[np.float32], flags: NDArray[np.uint8]
) -> NDArray[np.generic]:
    """Clip slopes (n, 2) to the search range, and set the flags (n,) of the valid ones that were clipped."""
    reach = table[groups.RANGE]
    at_limit = np.abs(away).max(axis=1) >= reach - groups.LIMIT_ROUNDING_PX
    flags &= ~_AT_SEARCH_LIMIT
    flags[at_limit & (flags & UNMEASURED == 0)] |= _AT_SEARCH_LIMIT
    slopes: NDArray[np.generic] = np.clip(away, -reach[:, None], reach[:, None])
    return slopes


def typical_images(n: int, window: tuple[int, int]) -> NDArray[np.float32]:
    """Return noise-free images (n, ny, nx) of spots of 300 e- at the window centres."""
    y, x = (np.arange(side) - 0.5 * (side - 1) for side in window)
    profile = np.exp(-0.5 * (y[:, None] ** 2 + x**2))
    spot = (_TYPICAL_FLUX_E * profile / profile.sum()).astype(np.float32)
    return np.tile(spot, (n, 1, 1))


class PythonPlan(EstimatorPlan):
    """Plan whose kernel calibrates images and flags bad ones; `locate` then finds the positions.

    Parameters
    ----------
    estimator : Estimator
        Estimator with its own `locate`, which is tested on typical spots.
    sensor : Sensor

    Raises
    ------
    InputError
        If the estimator fails on them.
    """

    kernel = staticmethod(gravity.gravity_of_groups)
    own_scratch = staticmethod(gravity.gravity_scratch)
    tables = gravity.GravityTables()
    setting_rows = gravity.SETTING_ROWS
    in_python = True

    def __init__(self, estimator: Estimator, sensor: Sensor) -> None:
        zero = sensor.zero.copy()
        zero.flags.writeable = False  # an estimator that writes into it would shift all later slopes
        super().__init__(estimator, replace(sensor, zero=zero))
        if type(estimator).locate is Estimator.locate:
            raise InputError(
                f"estimator {estimator.name!r}: expected a class with `locate` or `plan`, got neither"
            )
        self.found(typical_images(sensor.n, sensor.window), sensor.zero.copy())

    def fill_flux(self, table: NDArray[np.float32], flux_e: NDArray[np.float64]) -> None:
        """See `EstimatorPlan`."""
        keep_all(table)

    def found(self, images: NDArray[np.float32], prior: NDArray[np.float64]) -> Positions:
        """Return the positions that the estimator finds in one frame, with the flux filled in.

        Parameters
        ----------
        images : (n, ny, nx) float32
        prior : (n, 2) float64
            Predicted positions, px from the window centres.

        Raises
        ------
        InputError
            If `locate` raises or returns another shape: one line that names the estimator.
        """
        n, kind = self.sensor.n, type(self.estimator)
        flux = images.sum(axis=(1, 2))  # before `locate`, which may write into the images
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        title = f"estimator {self.estimator.name!r} of {file or kind.__module__}"
        with faults_of(title, file), np.errstate(all="ignore"):
            found = self.estimator.locate(images, self.sensor, prior)
            if not isinstance(found, Positions):
                array = np.asarray(found, np.float64)
                check_shape("locate", array, (n, 2))
                found = Positions(array[:, 0], array[:, 1])
            found = found._replace(flux=flux if found.flux is None else found.flux)
            values = [None if value is None else np.asarray(value, np.float64) for value in found]
            for name, value in zip(Positions._fields, values, strict=True):
                if value is not None:
                    check_shape(f"locate: {name}", value, (n,))
        return Positions(*values)  # type: ignore[arg-type]

    def locate_frame(
        self,
        images: NDArray[np.float32],
        prior: NDArray[np.float32],
        table: NDArray[np.float32],
        frame: int,
        slopes: SlopeArrays,
    ) -> None:
        """Write the slopes of one frame; `flags` hold those of the calibration.

        If the estimator fails, the failure is counted and all slopes of the frame are invalid.

        Parameters
        ----------
        images : (n, ny, nx) float32
        prior : (2, n) float32
            Predicted slopes, px from the reference.
        table : (rows, n) float32
            Settings table.
        frame : int
            Index of the frame in `slopes`.
        slopes : SlopeArrays
        """
        try:
            found: Positions | None = self.found(images, self.sensor.zero + prior.T)
        except InputError as error:
            self.faults, self.fault, found = self.faults + 1, str(error), None
        self.write(found, table, frame, slopes)

    def write(
        self, found: Positions | None, table: NDArray[np.float32], frame: int, slopes: SlopeArrays
    ) -> None:
        """Write the result of `found` into the slopes of a frame; None if nothing was found."""
        if found is None:
            nowhere = np.full(self.sensor.n, np.nan)
            found = Positions(nowhere, nowhere, nowhere)
        flux = not_none(found.flux)
        ny, nx = self.sensor.window
        usable = (np.abs(found.x) <= 0.5 * nx) & (np.abs(found.y) <= 0.5 * ny)  # false for NaN, too
        usable &= np.abs(flux) <= LARGEST_FLOAT32
        usable &= True if found.valid is None else found.valid != 0
        slopes.flux[frame] = np.where(usable, flux, 0.0)
        usable &= table[groups.ERROR_SCALE] > 0  # else known to be dark
        flags = slopes.flags[frame]
        flags &= ~_NO_FLUX
        flags[~usable & (flags & UNMEASURED == 0)] |= _NO_FLUX
        valid = (flags & UNMEASURED) == 0
        positions = np.stack([found.x, found.y], axis=1)
        away = np.where(valid[:, None], positions - self.sensor.zero, 0.0)
        slopes.x[frame], slopes.y[frame] = _limited(away, table, flags).T
        scale = table[groups.ERROR_SCALE]
        errors = found.standard_error_x, found.standard_error_y
        for error, result in zip(errors, (slopes.standard_error_x, slopes.standard_error_y), strict=True):
            known = False if error is None else valid & (error >= 0)
            result[frame] = np.where(known, scale * (0.0 if error is None else error), np.inf)
        covariance = 0.0 if found.covariance_xy is None else found.covariance_xy
        with np.errstate(invalid="ignore"):
            limit = slopes.standard_error_x[frame].astype(np.float64) * slopes.standard_error_y[frame]
            clipped = np.clip(scale**2 * covariance, -limit, limit)
        slopes.covariance_xy[frame] = np.where(np.isfinite(limit) & np.isfinite(clipped), clipped, 0.0)
