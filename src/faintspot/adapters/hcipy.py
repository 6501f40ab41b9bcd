"""The slope pipeline as an estimator of HCIPy (Por et al. 2018, Proc. SPIE 10703, 1070342)."""

from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.adapters.base import (
    AdapterOptions,
    ToolSlopes,
    check_version,
    largest_window,
    layout_around,
    on_detector,
    predicted,
)
from faintspot.base.checks import finite_array, number_between
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, SMALLEST_WINDOW

try:
    import hcipy
except ImportError:
    raise MissingExtraError("hcipy", "loop", "faintspot.adapters.hcipy") from None

TESTED = "0.7.1"


class SlopeEstimator(hcipy.WavefrontSensorEstimator):  # type: ignore[misc]
    """Slopes of a Shack-Hartmann sensor; replaces HCIPy's `ShackHartmannWavefrontSensorEstimator`.

    The first three arguments, the attributes of the same names and the slopes' shape, order, unit and grid
    are those of HCIPy's estimator, so that existing code and interaction matrices remain valid.

    Parameters
    ----------
    mla_grid : hcipy.Grid
        Lenslet centres, m.
    mla_index : hcipy.Field
        Number of the lenslet in front of each pixel, negative for none.
    estimation_subapertures : (mla_grid.size,) array of bool, optional
        Lenslets to measure. Default: all in `mla_index` whose window is wholly on the detector.
    settings : Settings
        Per-sub-aperture values are in the order of the `estimation_subapertures` attribute.
    calibration : Calibration, optional
        Default: images are in electrons. Its maps have the shape of `image.shaped`.
    detector_grid : hcipy.Grid, optional
        Pixel centres, m: regular and Cartesian. Default: the grid of `mla_index`; needed if the detector's
        pixels differ from the optics' grid.
    pixels : int, optional
        Side of the windows. Default: the largest without overlap. Windows are whole pixels; slopes are
        measured from the lenslet's centre in any case.
    predict : callable or object with `predict`, optional
        Takes the last slopes, (2, n) m, and returns the prediction for the next frame, for estimators that
        use a prior; called before each frame except the first.
    **options
        psf, weights, calibration_flux_e, flux_frames, threads: see `faintspot.adapters.base.ToolSlopes`.

    Attributes
    ----------
    estimation_subapertures : (n,) array of int
        Numbers of the measured lenslets.
    estimation_grid : hcipy.Grid
        Their centres: the grid of the slopes.
    measured : ToolSlopes
        Measures the slopes: `pipeline`, `last` slopes (px), `flux`.

    Raises
    ------
    InputError
        When the detector grid is not regular, lenslets are off the detector, the mask has the wrong size, or
        as for `faintspot.SlopePipeline`.
    """

    def __init__(
        self,
        mla_grid: Any,
        mla_index: object,
        estimation_subapertures: ArrayLike | None = None,
        *,
        settings: Settings,
        calibration: Calibration | None = None,
        detector_grid: object = None,
        pixels: int | None = None,
        predict: object = None,
        **options: Unpack[AdapterOptions],
    ) -> None:
        check_version("HCIPy", "hcipy", TESTED)
        self.mla_grid = mla_grid
        self.mla_index = mla_index
        self.detector_grid = _checked_grid(mla_index if detector_grid is None else detector_grid)
        zero, pitch = np.array(self.detector_grid.zero), np.array(self.detector_grid.delta)
        centres = finite_array("mla_grid", (_points(mla_grid) - zero) / pitch)
        side = largest_window(centres) if pixels is None else _checked_side(pixels)
        shape = self.detector_grid.shape
        self._frame_shape = int(shape[0]), int(shape[1])
        whole = on_detector(centres, self._frame_shape, side)
        self.estimation_subapertures = _measured(mla_index, estimation_subapertures, whole)
        selected = np.isin(np.arange(len(centres)), self.estimation_subapertures)
        self.estimation_grid = mla_grid.subset(selected)
        layout = layout_around(centres[selected], self._frame_shape, side)
        self.measured = ToolSlopes(layout, settings, calibration, unit_per_px=pitch, **options)
        self._predict, self._slopes = predict, None

    def estimate(self, images: object) -> Any:
        """Measure the slopes of an image.

        Parameters
        ----------
        images : list of one hcipy.Field
            Image of the detector, electrons (or ADU, with a calibration).

        Returns
        -------
        hcipy.Field
            (2, n), x then y: spot position from the centre of its lenslet, m on the detector, in the order
            and on the grid of HCIPy's estimator; 0 where `measured.last.flags` marks it as invalid.

        Raises
        ------
        InputError
            When the image is not on the detector's grid.
        """
        frame = self._frame(images)
        if self.measured.noise_free:
            return hcipy.Field(self.measured.measure(frame), self.estimation_grid)
        expected = predicted(self._predict, self._slopes, (2, self.estimation_grid.size))
        prior_px = None if expected is None else (expected / self.measured.unit_per_px).ravel()
        self._slopes = hcipy.Field(self.measured.measure(frame, prior_px=prior_px), self.estimation_grid)
        return self._slopes

    def recorded(self) -> NDArray[np.float64]:
        """Return the slopes of the last image for a recording, (2 n,) m: NaN where not measured."""
        last = self.measured.last
        return self.measured.recorded(np.stack([last.x, last.y]) * self.measured.unit_per_px)

    def calibrating(self, flux_e: float | None = None) -> Any:
        """Measure noise-free images in a `with` block; see `ToolSlopes.calibrating`."""
        return self.measured.calibrating(flux_e)

    @property
    def standard_errors(self) -> Any:
        """Field (2, n): standard errors of the last estimate, m; infinite where unknown."""
        return hcipy.Field(self.measured.standard_errors, self.estimation_grid)

    def _frame(self, images: Any) -> NDArray[np.generic]:
        """Return the image as rows and columns."""
        image = images[0] if isinstance(images, list | tuple) and len(images) == 1 else None
        height, width = self._frame_shape
        if image is None or np.size(image) != height * width:
            got = f"{type(images).__name__} of shape {np.shape(images)}"
            raise InputError(f"images: expected a list of one image of {height} x {width} pixels, got {got}")
        grid = getattr(image, "grid", self.detector_grid)
        if grid is not self.detector_grid and not _same_pixels(grid, self.detector_grid):
            raise InputError("images: expected pixels as in detector_grid, got an image on another grid")
        return np.asarray(image).reshape(self._frame_shape)


def _points(grid: object) -> NDArray[np.generic]:
    """Return the coordinates of a grid's points, (n, 2)."""
    if not isinstance(grid, hcipy.Grid) or grid.ndim != 2:
        raise InputError(f"mla_grid: expected a two-dimensional hcipy.Grid, got {type(grid).__name__}")
    return np.asarray(grid.as_("cartesian").points)


def _checked_grid(source: object) -> Any:
    """Return a regular two-dimensional Cartesian grid, given itself or as that of a field."""
    grid = source if isinstance(source, hcipy.Grid) else getattr(source, "grid", None)
    if grid is None:
        raise InputError("detector_grid: expected an hcipy.Grid, or mla_index on one, got none")
    if grid.ndim != 2 or not grid.is_("cartesian") or not grid.is_regular:
        raise InputError("detector_grid: expected a regular two-dimensional Cartesian grid, got another grid")
    return grid


def _same_pixels(grid: Any, other: Any) -> bool:
    """Return whether two grids have the same points within rounding."""
    if not grid.is_regular or not np.array_equal(grid.dims, other.dims):
        return False
    tolerance = 1e-3 * np.abs(other.delta)
    near = np.abs(grid.zero - other.zero) <= tolerance
    return bool(np.all(near & (np.abs(grid.delta - other.delta) * other.dims <= tolerance)))


def _checked_side(pixels: int) -> int:
    return int(number_between("pixels", pixels, SMALLEST_WINDOW, LARGEST_WINDOW, integer=True))


def _measured(mla_index: object, mask: ArrayLike | None, whole: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the numbers of the lenslets to measure; `whole` marks windows on the detector."""
    if mask is None:
        numbers = np.unique(finite_array("mla_index", mla_index).astype(np.int64))
        if numbers[-1] >= len(whole):
            raise InputError(f"mla_index: expected numbers below {len(whole)}, got {numbers[-1]}")
        numbers = numbers[numbers >= 0]
        numbers = numbers[whole[numbers]]
        if len(numbers) == 0:
            raise InputError("mla_grid: expected lenslets with their windows on the detector, got none")
        return numbers
    selected = np.asarray(mask)
    if selected.shape != whole.shape:
        raise InputError(
            f"estimation_subapertures: expected a mask of {len(whole)} lenslets, got shape {selected.shape}"
        )
    numbers = np.flatnonzero(selected)
    if len(numbers) == 0:
        raise InputError("estimation_subapertures: expected at least one lenslet, got none")
    outside = numbers[~whole[numbers]]
    if len(outside):
        raise InputError(
            f"estimation_subapertures: expected windows on the detector, got {len(outside)} that leave it, "
            f"first lenslet {outside[0]}; leave them out or give fewer pixels"
        )
    return numbers
