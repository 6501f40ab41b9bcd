"""The slope pipeline: frame -> calibrate -> denoise -> background -> centroid -> slopes."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from faintspot.checks import finite_array, number_between, one_of, real_array
from faintspot.errors import InputError
from faintspot.flags import INVALID
from faintspot.kernels import fused, located, thresholded
from faintspot.kernels.host import WIDTHS, lanes_for
from faintspot.kernels.parallel import run_groups
from faintspot.preparation import METHODS, Preparation, packed_calibration
from faintspot.sensor import configuration
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.sensor.settings import Settings

if TYPE_CHECKING:
    from faintspot.cuda import DevicePipeline

RESULT_TYPES = (np.float32, np.float32, np.float32, np.uint8, np.int32, np.int32, np.float32, np.float32)


@dataclass(frozen=True)
class Slopes:
    """Slopes of one frame, arrays of shape (n_subapertures,), or of several, (n_frames, n_subapertures)."""

    x: NDArray[np.float32]
    """Position of the spot along columns, px from the reference; 0 where invalid."""
    y: NDArray[np.float32]
    """Position along rows."""
    flux: NDArray[np.float32]
    """Electrons left after the background subtraction."""
    flags: NDArray[np.uint8]
    """Bits of `SubapertureFlag`."""
    iterations: NDArray[np.int32]
    """Iterations that the denoising took."""
    bad_pixels: NDArray[np.int32]
    """Number of pixels that were masked, NaN or infinite."""
    standard_error_x: NDArray[np.float32]
    """Standard error of x, px; infinite where invalid, and where the read noise is not known."""
    standard_error_y: NDArray[np.float32]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether the slope was measured."""
        return (self.flags & INVALID) == 0  # type: ignore[no-any-return]

    @property
    def vector(self) -> NDArray[np.float32]:
        """All x, then all y, along the last axis: what a reconstructor multiplies."""
        return np.concatenate([self.x, self.y], axis=-1)


@dataclass(frozen=True)
class Stages:
    """The sub-aperture images after every step, (..., n_subapertures, ny, nx), and the slopes."""

    raw: NDArray[Any]
    """As in the frame, ADU."""
    calibrated: NDArray[np.float32]
    """Electrons, bad pixels filled."""
    denoised: NDArray[np.float32]
    background_subtracted: NDArray[np.float32]
    slopes: Slopes


class SlopePipeline:
    """Turns frames into slopes.

    Parameters
    ----------
    layout : Layout
    settings : Settings
    calibration : Calibration, optional
        Default: frames are in electrons already.
    reference : array or Slopes, optional
        Reference positions, px from each sub-aperture's centre, subtracted from every position: (n, 2) x and
        y, or (2 n,) all x then all y, or the slopes of one frame. Default 0.
    psf : PSF, optional
        Needed by the estimators "matched", "ml" and "map"; tells "weighted" and "auto" the spots' width.
    score : TrainedScore, optional
        Needed by the estimator "trained".
    width : int, optional
        SIMD width in float32 numbers: 4, 8 or 16. Default: what the machine has.
    threads : int, optional
        Most threads to use. Default: all processors that the process may use. Slopes do not depend on it.
    device : {"cpu", "cuda"}, optional
        Where frames are measured. On an NVIDIA GPU ("cuda", see `faintspot.cuda`) with the estimators "cog",
        "smoothed" and "thresholded"; `explain` and `kernel_call` use the CPU always.

    Raises
    ------
    InputError
        When the parts do not fit together, and for "cuda" without a GPU.
    MissingExtraError
        For "cuda" without the extra `gpu`.

    Examples
    --------
    >>> import faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    >>> pipeline = fs.SlopePipeline(layout, fs.Settings(noise_std=0.5, keep_brightest=12))
    >>> slopes = pipeline(frame)  # doctest: +SKIP
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        calibration: Calibration | None = None,
        reference: ArrayLike | Slopes | None = None,
        *,
        psf: PSF | None = None,
        score: TrainedScore | None = None,
        width: int | None = None,
        threads: int | None = None,
        device: str = "cpu",
    ) -> None:
        self.layout = layout
        self.settings = settings
        self.calibration = Calibration() if calibration is None else calibration
        self.threads = (
            None if threads is None else int(number_between("threads", threads, 1, 4096, integer=True))
        )
        self._lanes = lanes_for(np.float32, width)
        self._calibration = packed_calibration(layout, self.calibration, self._lanes.width)
        self._parts = psf, score, layout.offsets + _reference_positions(reference, len(layout))
        self._preparation = self._prepared()
        self._in_rows = self._row_arguments()
        self._identity = _identity(*self._parts)
        self.device = one_of("device", device, ("cpu", "cuda"))
        self.on_device = self._device_pipeline() if self.device == "cuda" else None

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> SlopePipeline:
        """Make the pipeline that a configuration file (faintspot.toml) describes."""
        layout, settings, calibration, psf, score = configuration.load_all(path)
        return cls(layout, settings, calibration, psf=psf, score=score, **options)

    def _prepared(self) -> Preparation:
        """Make the tables for the SIMD lanes that are set."""
        return Preparation(self.layout, self.settings, self.calibration, *self._parts, self._lanes.width)

    def _device_pipeline(self) -> DevicePipeline:
        """Bring the tables to the GPU."""
        from faintspot.cuda.availability import check_cuda

        check_cuda()
        from faintspot.cuda.measuring import DevicePipeline

        return DevicePipeline(self.layout, self.settings, self.calibration, self._preparation)

    @property
    def width(self) -> int:
        """Sub-apertures that are measured at once."""
        return self._lanes.width

    def with_width(self, width: int) -> SlopePipeline:
        """Return the same pipeline with another SIMD width: 4, 8 or 16. Slopes do not depend on it.

        Raises
        ------
        InputError
            For another width.
        """
        other = copy.copy(self)
        other._lanes = lanes_for(np.float32, width)
        other._calibration = packed_calibration(self.layout, self.calibration, width)
        other._preparation = other._prepared()
        other._in_rows = other._row_arguments()
        other.on_device = None if self.on_device is None else other._device_pipeline()
        return other

    @property
    def needs_light(self) -> bool:
        """Whether settings follow the light of each frame, which is looked at before it is measured."""
        return self._preparation.needs_light

    def fingerprint(self) -> bytes:
        """Return bytes that differ between pipelines that could give different slopes for the same frame."""
        parts = (self.layout.corners, self.calibration.maps(self.layout.frame_shape))
        calibration = self.calibration
        text = (
            f"{self.layout.window} {calibration.saturation_adu} {calibration.read_noise_e} "
            f"{calibration.background_e} {calibration.em_gain} {configuration.to_text(self.settings)}"
        )
        return (
            b"".join(np.ascontiguousarray(part).tobytes() for part in parts) + self._identity + text.encode()
        )

    def __call__(self, frame: ArrayLike, prior: ArrayLike | Slopes | None = None) -> Slopes:
        """Measure the slopes of a frame (h, w) or of frames (n, h, w), in ADU.

        NaN and infinite pixels count as bad pixels; a sub-aperture that cannot be measured is flagged.

        Parameters
        ----------
        frame : array
        prior : array or Slopes, optional
            Predicted slopes, px, for "map" (the mean of its prior) and "trained" (where it begins): as
            `reference`, or one such array for every frame. Default 0.

        Raises
        ------
        InputError
            For a frame that is not real or not of the layout's shape, or a prior of the wrong shape.
        """
        return self._run(self._checked(frame), prior, explain=False)[0]

    def explain(self, frame: ArrayLike, prior: ArrayLike | Slopes | None = None) -> Stages:
        """Return the sub-aperture images after every step, for pictures and for finding faults.

        Estimators that work on the calibrated image itself leave it as it is in every step.
        """
        array = self._checked(frame)
        slopes, stages = self._run(array, prior, explain=True)
        calibrated, denoised, background = stages.reshape(3, *slopes.x.shape, *self.layout.window)
        return Stages(self.layout.images(array), calibrated, denoised, background, slopes)

    def _checked(self, frame: ArrayLike) -> NDArray[Any]:
        array = real_array("frame", frame, minimum_dimensions=2)
        if array.ndim > 3 or array.shape[-2:] != self.layout.frame_shape:
            height, width = self.layout.frame_shape
            raise InputError(
                f"frame: expected shape ({height}, {width}) or (n, {height}, {width}), got {array.shape}"
            )
        return array

    def _run(
        self, array: NDArray[Any], prior: ArrayLike | Slopes | None, explain: bool
    ) -> tuple[Slopes, NDArray[np.float32]]:
        """Compute the slopes, and the stages where asked for."""
        frames = _kernel_frames(array)
        n_frames, n = len(frames), len(self.layout)
        results = tuple(np.empty((n_frames, n), dtype) for dtype in RESULT_TYPES)
        stages = np.empty((fused.STAGE_ROWS if explain else 0, n_frames, n, self.layout.pixels), np.float32)
        variants = self._variants(frames, self.calibration.saturation(array.dtype))
        if self.on_device is not None and not explain:
            measured = self.on_device.measure_from_host(frames, array.dtype, variants)
            return Slopes(*(result.reshape(*array.shape[:-2], n) for result in measured)), stages
        kernel, before, shape = self.kernel_call(frames, array.dtype, variants, prior)

        def job(start: int, stop: int, scratch: tuple[Any, ...]) -> None:
            kernel(*before, start, stop, scratch, results, stages)

        n_groups = n_frames * -(-n // self._lanes.width)
        run_groups(job, n_groups, self._lanes, self.layout.window, self.threads, shape)
        shaped: Any = (result.reshape(*array.shape[:-2], n) for result in results)
        return Slopes(*shaped), stages

    def kernel_call(
        self,
        frames: NDArray[Any],
        dtype: DTypeLike,
        variants: NDArray[np.int64],
        prior: ArrayLike | Slopes | None = None,
    ) -> tuple[Any, tuple[Any, ...], tuple[int, int, int] | None]:
        """Return the compiled function that measures frames, and its arguments before the range of groups.

        For those who call it themselves, group by group; everybody else calls the pipeline.

        Parameters
        ----------
        frames : (n, h, w) array, uint16 or float32
        dtype : dtype
            Of the camera's pixels, which says at what value they saturate.
        variants : (n,) int64
            Table of settings of each frame: 0 unless settings depend on the light.
        prior : array or Slopes, optional
            As when the pipeline is called.

        Returns
        -------
        function, arguments, scratch shape (see `faintspot.kernels.parallel.run_groups`)
        """
        plan, n = self._preparation, len(self.layout)
        saturation = self.calibration.saturation(np.dtype(dtype))
        tables, constants, shape = plan.arguments()
        source = (self._lanes, frames, self.layout.corners, *self.layout.window, self._calibration)
        if plan.estimator in METHODS:
            predicted = plan.no_prior if prior is None else _prior_slopes(prior, len(frames), n)
            arguments = (*source, saturation, tables, variants, predicted, *constants)
            return located.locate_groups, arguments, shape
        arguments = (*source, saturation, tables, variants, *constants)
        if self._in_rows is not None:
            return thresholded.thresholded_slopes, (*self._in_rows, *arguments), shape
        return fused.slopes_of_groups, arguments, shape

    def _row_arguments(self) -> tuple[Any, ...] | None:
        """What the kernel takes that measures pixels in rows, where that is possible."""
        columns = self.layout.window[1]
        widths = [width for width in WIDTHS if columns % width == 0 and width <= self._lanes.width]
        if self.settings.estimator != "thresholded" or not widths:
            return None
        maps = np.ascontiguousarray(self.calibration.maps(self.layout.frame_shape), np.float32)
        ramp = np.arange(columns, dtype=np.float32) - np.float32(0.5 * (columns - 1))
        return lanes_for(np.float32, max(widths)), maps, ramp

    def _variants(self, frames: NDArray[Any], saturation: float) -> NDArray[np.int64]:
        """Which table of settings every frame is measured with, by its light where that matters."""
        n_frames, n = len(frames), len(self.layout)
        if not self._preparation.needs_light:
            return np.zeros(n_frames, np.int64)
        light = np.empty((n_frames, n), np.float32)
        source = (self._lanes, frames, self.layout.corners, *self.layout.window, self._calibration)

        def job(start: int, stop: int, scratch: tuple[Any, ...]) -> None:
            fused.light_of_groups(*source, saturation, start, stop, scratch, light)

        n_groups = n_frames * -(-n // self._lanes.width)
        run_groups(job, n_groups, self._lanes, self.layout.window, self.threads)
        return self._preparation.variants(light.mean(axis=1, dtype=np.float64))


def _kernel_frames(array: NDArray[Any]) -> NDArray[Any]:
    """The frames as the kernel reads them: (n, h, w), contiguous, uint16 or float32."""
    dtype = np.uint16 if array.dtype in (np.uint8, np.uint16) else np.float32
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite: a bad pixel
        frames = np.ascontiguousarray(array, dtype=dtype)
    return frames.reshape(-1, *array.shape[-2:])


def _reference_positions(reference: ArrayLike | Slopes | None, n: int) -> NDArray[np.float64]:
    """Reference positions as (n, 2)."""
    if reference is None:
        return np.zeros((n, 2))
    array = finite_array("reference", reference.vector if isinstance(reference, Slopes) else reference)
    if array.shape == (2 * n,):
        return np.stack([array[:n], array[n:]], axis=1).astype(np.float64)
    if array.shape != (n, 2):
        raise InputError(f"reference: expected shape ({n}, 2) or ({2 * n},), got {array.shape}")
    return array.astype(np.float64)


def _prior_slopes(prior: ArrayLike | Slopes, n_frames: int, n: int) -> NDArray[np.float32]:
    """Predicted slopes as the kernel reads them: (1 or n_frames, 2, n)."""
    array = finite_array("prior", prior.vector if isinstance(prior, Slopes) else prior)
    if array.shape in ((n, 2), (n_frames, n, 2)):
        array = np.moveaxis(array, -1, -2)
    elif array.shape not in ((2 * n,), (n_frames, 2 * n)):
        raise InputError(
            f"prior: expected shape ({n}, 2) or ({2 * n},), or as many for each of the {n_frames} frames, "
            f"got {array.shape}"
        )
    return np.ascontiguousarray(array.reshape(-1, 2, n), np.float32)


def _identity(psf: PSF | None, score: TrainedScore | None, zero: NDArray[np.float64]) -> bytes:
    """A digest of what slopes depend on beside layout, settings and calibration."""
    digest = hashlib.sha256(zero.tobytes())
    for part in (psf, score):
        for field in fields(part) if part is not None else ():
            value = getattr(part, field.name)
            whole = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            digest.update(f"{type(part).__name__}.{field.name}".encode() + whole)
    return digest.digest()
