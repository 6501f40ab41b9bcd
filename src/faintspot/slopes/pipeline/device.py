"""Measurement of slopes on the GPU: transfer of tables, kernel launches and results."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numba import cuda
from numpy.typing import DTypeLike, NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.estimators.registry import estimators
from faintspot.slopes.kernels.cuda.flat_start import inverse_pivots
from faintspot.slopes.kernels.cuda.fused import (
    BAD_COUNT,
    COVARIANCE,
    ERROR_X,
    ERROR_Y,
    FEWEST_BLOCKS,
    FLUX,
    ITERATIONS,
    WARPS,
    X,
    Y,
    slopes_kernel,
)
from faintspot.slopes.kernels.cuda.strips import WARP

if TYPE_CHECKING:
    from faintspot.slopes.camera.calibration import Calibration
    from faintspot.slopes.estimators.built_in.gravity import GravityPlan
    from faintspot.slopes.pipeline.plan import Plan
    from faintspot.slopes.sensor.layout import Layout

MOST_FRAMES = 65535
"""Maximum number of frames in one launch (limit of CUDA's grid along y)."""

MOST_FRAME_PIXELS = 2**31 - 1
"""Maximum number of pixels of a frame (limit of int32 indices)."""

_MOST_BYTES = 1 << 28  # of frames on the GPU at a time


@dataclass(frozen=True)
class DeviceSlopes:
    """Slopes in GPU memory, arrays of shape (n_frames, n_subapertures); see `Slopes`.

    The arrays are Numba device arrays, which CuPy, PyTorch and JAX accept directly.
    """

    x: Any
    y: Any
    flux: Any
    flags: Any
    iterations: Any
    bad_pixels: Any
    standard_error_x: Any
    standard_error_y: Any
    covariance_xy: Any


@dataclass(frozen=True)
class Results:
    """Results of the kernel in one block of memory, which is transferred at once."""

    memory: Any
    """uint8."""
    numbers: Any
    counts: Any
    flags: Any

    @classmethod
    def within(cls, memory: Any, n_frames: int, n: int) -> Results:
        """Lay out memory of `size_of` bytes, on the host or on the GPU."""
        size = n_frames * n
        numbers = memory[: 24 * size].view(np.float32).reshape(6, n_frames, n)
        counts = memory[24 * size : 32 * size].view(np.int32).reshape(2, n_frames, n)
        return cls(memory, numbers, counts, memory[32 * size : 33 * size].reshape(n_frames, n))

    @staticmethod
    def size_of(n_frames: int, n: int) -> int:
        """Return the number of bytes for n_frames frames of n sub-apertures."""
        return 33 * n_frames * n

    def slopes(self) -> DeviceSlopes:
        """Return the results by name, as views."""
        numbers, counts = self.numbers, self.counts
        return DeviceSlopes(
            numbers[X],
            numbers[Y],
            numbers[FLUX],
            self.flags,
            counts[ITERATIONS],
            counts[BAD_COUNT],
            numbers[ERROR_X],
            numbers[ERROR_Y],
            numbers[COVARIANCE],
        )


class DevicePipeline:
    """GPU part of a pipeline, available as `SlopePipeline(..., device="cuda").on_device`.

    Parameters
    ----------
    layout : Layout
    calibration : Calibration
    plan : Plan
        Tables of the pipeline.

    Raises
    ------
    InputError
        If the estimator runs on the CPU only, or the windows are too large for a warp.
    """

    def __init__(self, layout: Layout, calibration: Calibration, plan: Plan) -> None:
        if plan.sensor.has_noise_map:
            raise InputError(
                'calibration.read_noise_e: expected a number with device="cuda", got a map; use device="cpu"'
            )
        if not plan.estimator.runs_on_gpu:
            able = ", ".join(repr(name) for name, kind in estimators().items() if kind.runs_on_gpu)
            raise InputError(
                f'estimator = {plan.estimator.name!r}: device="cuda" runs {able}; use one of these or '
                'device="cpu"'
            )
        self.layout = layout
        self.calibration = calibration
        self._plan = plan
        prepared = cast("GravityPlan", plan.prepared)  # of all estimators that run on the GPU
        first_step = prepared.first_step
        self._kernel = slopes_kernel(layout.window, prepared.before, first_step.algorithm)
        height, line = layout.frame_shape
        if height * line > MOST_FRAME_PIXELS:
            raise InputError(
                f'frame of {height} x {line} pixels: device="cuda" takes at most {MOST_FRAME_PIXELS}; '
                "use several frames"
            )
        self._line = np.int32(line)
        self._places = cuda.to_device((layout.corners @ [line, 1]).astype(np.int32))
        maps = np.asarray(calibration.maps(layout.frame_shape), np.float32)
        self._maps = cuda.to_device(np.ascontiguousarray(maps.reshape(2, -1)))
        taps = np.ones((len(layout), 2, 1)) if first_step.taps is None else first_step.taps  # ones: not used
        self._taps = cuda.to_device(np.ascontiguousarray(taps, np.float32))
        self._pivots = cuda.to_device(inverse_pivots(layout.window))
        self._tables: tuple[NDArray[np.float32], Any] | None = None
        self._first_variants = cuda.to_device(np.zeros(1, np.int32))

    @property
    def needs_flux(self) -> bool:
        """Whether settings follow the flux of each frame, which is measured on the CPU only."""
        return self._plan.needs_flux

    def measure(self, frames: Any, *, stream: Any = 0) -> DeviceSlopes:
        """Measure frames in GPU memory; the slopes remain there.

        A stack of images (n, ny, nx), each with its own settings, is passed as the sub-apertures of one
        tall frame (n * ny, nx); see `faintspot.measure_images` for its layout.

        Parameters
        ----------
        frames : (h, w) or (n, h, w) array on the GPU, uint16 or float32, contiguous
            Numba array, or any object with `__cuda_array_interface__`, such as a CuPy or PyTorch array.
        stream : Numba stream, optional
            Stream of the kernel launch. The call returns before the kernel has run.

        Raises
        ------
        InputError
            If the frames have another type or shape, or if settings follow the flux of each frame.
        """
        self.check_constant_flux()
        array = frames if hasattr(frames, "copy_to_host") else _as_device_array(frames)
        if array.ndim == 2:
            array = array.reshape(1, *array.shape)
        if array.ndim != 3 or tuple(array.shape[1:]) != tuple(self.layout.frame_shape):
            height, width = self.layout.frame_shape
            raise InputError(
                f"frames: expected shape ({height}, {width}) or (n, {height}, {width}), got {frames.shape}"
            )
        if np.dtype(array.dtype) not in (np.uint16, np.float32):
            raise InputError(f"frames: expected uint16 or float32 on the GPU, got {array.dtype}")
        n_frames = len(array)
        if n_frames > MOST_FRAMES:
            raise InputError(f"frames: expected at most {MOST_FRAMES} at a time, got {n_frames}")
        variants = self._first_variants
        if n_frames > 1:
            variants = cuda.to_device(np.zeros(n_frames, np.int32), stream=stream)
        results = self.new_results(n_frames)
        self.launch(array, array.dtype, variants, results, stream)
        return results.slopes()

    def measure_from_host(
        self, frames: NDArray[Any], dtype: DTypeLike, variants: NDArray[np.int64]
    ) -> tuple[NDArray[Any], ...]:
        """Measure frames (n, h, w) in host memory; return the arrays of `Slopes`, (n, n_subapertures).

        Parameters
        ----------
        frames : (n, h, w) array, uint16 or float32, contiguous
        dtype : dtype
            Type of the camera's pixels, which sets their saturation level.
        variants : (n,) int64
            Settings table of each frame.
        """
        most = min(max(1, _MOST_BYTES // frames[0].nbytes), MOST_FRAMES)
        parts = []
        for start in range(0, len(frames), most):
            block = frames[start : start + most]
            results = self.new_results(len(block))
            which = cuda.to_device(np.ascontiguousarray(variants[start : start + most], np.int32))
            self.launch(cuda.to_device(block), dtype, which, results)
            memory = results.memory.copy_to_host()
            slopes = Results.within(memory, len(block), len(self.layout)).slopes()
            parts.append([getattr(slopes, field.name) for field in fields(slopes)])
        return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))

    def new_results(self, n_frames: int) -> Results:
        """Allocate GPU memory for the slopes of a number of frames."""
        n = len(self.layout)
        memory = cuda.device_array(Results.size_of(n_frames, n), np.uint8)
        return Results.within(memory, n_frames, n)

    def launch(self, frames: Any, dtype: DTypeLike, variants: Any, results: Results, stream: Any = 0) -> None:
        """Launch the kernel on GPU arrays; parameters as those of `slopes_kernel`."""
        blocks = max(-(-len(self.layout) // WARPS), FEWEST_BLOCKS), len(frames)
        self._kernel[blocks, WARPS * WARP, stream](
            frames.reshape(len(frames), self._maps.shape[1]),
            self._line,
            self._places,
            self._maps,
            np.float32(self.calibration.saturation(np.dtype(dtype))),
            self._tables_on_device(),
            variants,
            self._taps,
            self._pivots,
            results.numbers,
            results.counts,
            results.flags,
        )

    def check_constant_flux(self) -> None:
        """Raise an error if settings follow the flux of each frame.

        Raises
        ------
        InputError
            If they do.
        """
        if self.needs_flux:
            raise InputError(
                "settings.flux_e: expected the flux per sub-aperture, since automatic settings would "
                "follow the flux of each frame, which is measured on the CPU only"
            )

    def _tables_on_device(self) -> Any:
        """Return the settings tables on the GPU, transferred again only if they have changed."""
        tables = self._plan.settings
        if self._tables is None or self._tables[0] is not tables:
            self._tables = tables, cuda.to_device(np.ascontiguousarray(tables, np.float32))
        return self._tables[1]


def _as_device_array(frames: Any) -> Any:
    """Return an array of another library as a Numba device array, without copying."""
    if not hasattr(frames, "__cuda_array_interface__"):
        raise InputError(
            f"frames: expected an array on the GPU, got {type(frames).__name__}; call the pipeline for "
            "frames in the host's memory"
        )
    return cuda.as_cuda_array(frames)
