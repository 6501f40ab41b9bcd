"""SPECULA's slope computer with faintspot's slope pipeline."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import (
    CALIBRATION_FLUX_E,
    FLUX_FRAMES,
    AdapterOptions,
    ToolSlopes,
    check_matrix,
    check_version,
    parts_of,
)
from faintspot.base.checks import check_shape
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.slopes.sensor.layout import Layout

try:
    from specula import cpuArray
    from specula.base_processing_obj import InputDesc, OutputDesc
    from specula.connections import InputValue
    from specula.data_objects.slopes import Slopes
    from specula.data_objects.subap_data import SubapData
    from specula.processing_objects.slopec import Slopec
except ImportError:
    raise MissingExtraError("specula", "specula", "faintspot.adapters.specula") from None

TESTED = "1.1.0"


class FaintspotSlopec(Slopec):  # type: ignore[misc]
    """Slopes of a Shack-Hartmann sensor; replaces SPECULA's `ShSlopec`.

    Unit, order and sign of the slopes, slope nulls, filters and calibration files are those of `ShSlopec`.
    Pixels are in electrons, or in ADU with a calibration.

    Parameters
    ----------
    subapdata : SubapData
        SPECULA's sub-apertures.
    faintspot : str or dict
        A faintspot.toml, or its tables: `settings` (and `estimator`), `calibration`, `psf`, `weights`.
    calibrating : bool
        True in parameter files for calibration (slope null, interaction matrix), whose detector is
        noise-free: frames are then measured at `calibration_flux_e`, see `ToolSlopes.calibrating`.
    calibration_flux_e : float
        Mean flux of a sub-aperture in calibrations, electrons.
    flux_frames : float
        Time constant of the running mean of the flux, frames; 0: none.
    sn, filtmat, interleave, target_device_idx, precision
        As for `ShSlopec`; slopes are measured on the CPU.

    Raises
    ------
    InputError
        When sub-apertures are not squares of pixels, or as for `ToolSlopes`.
    """

    def __init__(
        self,
        subapdata: SubapData,
        faintspot: Any = None,
        sn: Slopes = None,
        calibrating: bool = False,
        calibration_flux_e: float = CALIBRATION_FLUX_E,
        flux_frames: float = FLUX_FRAMES,
        filtmat: Any = None,
        interleave: bool = False,
        target_device_idx: int | None = None,
        precision: int | None = None,
    ) -> None:
        check_version("SPECULA", "specula", TESTED)
        for part in () if filtmat is None else filtmat:
            check_matrix("filtmat", cpuArray(part))
        self.subapdata = subapdata  # used by the base class for the number of sub-apertures
        super().__init__(
            sn=sn,
            filtmat=filtmat,
            interleave=interleave,
            target_device_idx=target_device_idx,
            precision=precision,
        )
        parts = parts_of(faintspot)
        self._settings, self._calibration = parts.settings, parts.calibration
        self._options: AdapterOptions = {
            "psf": parts.psf,
            "weights": parts.weights,
            "calibration_flux_e": calibration_flux_e,
            "flux_frames": flux_frames if flux_frames > 0 else None,
        }
        self._noise_free = bool(calibrating)
        self._tool: ToolSlopes | None = None
        self._idxs, self._frame_shape = np.empty((0, 0), np.int64), (0, 0)
        self.slopes.single_mask, self.slopes.display_map = subapdata.single_mask(), subapdata.display_map
        self.recorded = Slopes(
            self.nslopes(), interleave=interleave, target_device_idx=self.target_device_idx
        )
        """Copy of `out_slopes`, with NaN for slopes that are not valid."""
        self.inputs["in_predicted"] = InputValue(type=Slopes, optional=True)
        self.outputs["out_recorded"] = self.recorded
        self.outputs["out_subapdata"] = subapdata

    @classmethod
    def input_names(cls) -> object:
        """Return SPECULA's inputs, and the predicted slopes."""
        return {
            **super().input_names(),
            "in_predicted": InputDesc(Slopes, "Predicted slopes, after the slope null (optional)"),
        }

    @classmethod
    def output_names(cls) -> object:
        """Return SPECULA's outputs, sub-apertures, and slopes for recordings and the predictive filter."""
        return {
            **super().output_names(),
            "out_subapdata": OutputDesc(SubapData, "Sub-apertures"),
            "out_recorded": OutputDesc(Slopes, "Slopes, NaN where not measured"),
        }

    def nsubaps(self) -> int:
        """Return the number of sub-apertures."""
        return int(self.subapdata.n_subaps)

    def nslopes(self) -> int:
        """Return the number of slopes, twice that of sub-apertures."""
        return 2 * self.nsubaps()

    @property
    def measured(self) -> ToolSlopes:
        """Measurement: `last` slopes (px), flags, `standard_errors`, `flux`.

        Raises
        ------
        InputError
            When there was no frame yet.
        """
        if self._tool is None:
            raise InputError("slopes: no frame has been measured yet; measure one first")
        return self._tool

    def compute_slopes(self) -> None:
        """Measure the input pixels; SPECULA then subtracts the slope null."""
        pixels = np.asarray(cpuArray(self.local_inputs["in_pixels"].pixels))
        if self._tool is None:
            self._tool, self._idxs = self._prepared((int(pixels.shape[0]), int(pixels.shape[1])))
            self._frame_shape = pixels.shape
        check_shape("in_pixels", pixels, self._frame_shape)
        images, n = pixels.ravel()[self._idxs], self.nsubaps()
        null = np.zeros((2, n)) if self.sn is None else _two_rows("sn", self.sn, n)
        prior, predicted = None, self.local_inputs.get("in_predicted")
        if predicted is not None and predicted.generation_time > 0:
            prior = ((_two_rows("in_predicted", predicted, n) + null) / self._tool.unit_per_px).ravel()
        found = self._tool.measure(images, prior_px=prior, noise_free=self._noise_free)
        last = self._tool.last
        found = np.where(last.measured, found, null)
        self.slopes.xslopes, self.slopes.yslopes = (self.to_xp(row, dtype=self.dtype) for row in found)
        flux = np.nan_to_num(last.flux).astype(np.float64)
        self.flux_per_subaperture_vector.value[:] = self.to_xp(flux, dtype=self.dtype)
        self.total_counts.value[:] = flux.sum()
        self.subap_counts.value[:] = flux.mean()

    def post_trigger(self) -> None:
        """Set the time of the outputs."""
        super().post_trigger()
        unmeasured = self.to_xp(np.where(self.measured.last.measured, 0.0, np.nan), dtype=self.dtype)
        self.recorded.xslopes = self.slopes.xslopes + unmeasured
        self.recorded.yslopes = self.slopes.yslopes + unmeasured
        for name in ("out_subapdata", "out_recorded"):
            self.outputs[name].generation_time = self.current_time

    def _prepared(self, frame_shape: tuple[int, int]) -> tuple[ToolSlopes, NDArray[np.int64]]:
        """Create the pipeline for frames of a shape; return it, and its pixels as one tall frame."""
        idxs = checked_squares(np.asarray(cpuArray(self.subapdata.idxs)), frame_shape)
        n, side = len(idxs), int(self.subapdata.np_sub)
        layout, unit = Layout.stacked(n, (side, side)), (2.0 / side, 2.0 / side)
        tool = ToolSlopes(layout, self._settings, self._calibration, unit_per_px=unit, **self._options)
        return tool, idxs.reshape(n * side, side)


def checked_squares(idxs: NDArray[Any], frame_shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return SPECULA's sub-apertures after checking that they are squares of a frame's pixels.

    Parameters
    ----------
    idxs : (n, pixels) array of int
        Pixels of each sub-aperture, counted along the rows of the frame.
    frame_shape : (int, int)

    Raises
    ------
    InputError
        When they are not squares of pixels, row by row, or leave the frame.
    """
    height, width = frame_shape
    if idxs.min() < 0 or idxs.max() >= height * width:
        raise InputError(
            f"subapdata.idxs: expected pixels of frames of {height} x {width}, got numbers up to {idxs.max()}"
            "; calibrate the sub-apertures with this detector"
        )
    side = math.isqrt(idxs.shape[1])
    square = (width * np.arange(side)[:, None] + np.arange(side)).ravel()
    inside = idxs[:, 0] % width + side <= width
    if side * side != idxs.shape[1] or not (idxs == idxs[:, :1] + square).all() or not inside.all():
        raise InputError(
            f"subapdata.idxs: expected squares of pixels, row by row, of frames of {height} x {width}, got "
            "others; calibrate the sub-apertures with this detector"
        )
    return idxs.astype(np.int64)


def _two_rows(name: str, slopes: Any, n: int) -> NDArray[np.float64]:
    """Return x and y slopes of a Slopes object, (2, n)."""
    rows = [np.asarray(cpuArray(part), np.float64).ravel() for part in (slopes.xslopes, slopes.yslopes)]
    if rows[0].size != n or rows[1].size != n:
        raise InputError(
            f"{name}: expected slopes of {n} sub-apertures, got {rows[0].size} x and {rows[1].size} y; "
            "calibrate with these sub-apertures"
        )
    bad = sum(int(np.count_nonzero(~np.isfinite(row))) for row in rows)
    if bad:
        raise InputError(
            f"{name}: expected finite numbers, got {bad} NaN or infinite of {2 * n}; remake it with "
            "every sub-aperture illuminated"
        )
    return np.stack(rows)
