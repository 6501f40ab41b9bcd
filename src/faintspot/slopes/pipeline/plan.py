"""Settings and tables that a pipeline computes before the first frame, in the form that kernels read."""

import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.options import is_auto
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.base import Estimator, EstimatorPlan
from faintspot.slopes.estimators.sensor import Sensor
from faintspot.slopes.kernels import groups
from faintspot.slopes.kernels.compiling import Direct
from faintspot.slopes.kernels.groups import Scratch, SlopeArrays, Source, Task
from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.validity.dark import LightTest
from faintspot.slopes.kernels.validity.doubtful import Expected
from faintspot.slopes.pipeline.settings import Settings, spot_fwhm_px
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.region import (
    LEAST_DIFFERENCE,
    LEAST_DIFFERENCE_PX,
    continued,
    lines_of,
    neighbours_of,
)
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

_FWHM_OF_KEPT = 0.58  # px, times the square root of a good number of kept pixels: 12 for a FWHM of 2 px
_MOST_FLUX_E = 9e8  # mean flux per sub-aperture above which settings stay constant


def packed_calibration(layout: Layout, maps: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Return dark and scale of all sub-aperture pixels in the order in which the kernel reads them.

    The shape is (n_groups, pixels, 2, W); the last group is padded with its last sub-aperture. `maps` are
    those of `Calibration.maps`.
    """
    return _packed(layout.images(maps), width)


def _packed(windows: NDArray[np.generic], width: int) -> NDArray[np.float32]:
    """Return windows of several maps (k, n, ny, nx) as (n_groups, pixels, k, W)."""
    count, n = windows.shape[:2]
    n_groups = -(-n // width)
    lanes = windows.reshape(count, n, -1)[:, np.minimum(np.arange(n_groups * width), n - 1)]
    groups = lanes.reshape(count, n_groups, width, -1).transpose(1, 3, 0, 2)
    return np.ascontiguousarray(groups, np.float32)


KERNEL_TYPES = (np.dtype(np.uint16), np.dtype(np.float32))
"""Types of the pixels of frames that kernels read."""


def kernel_frames(array: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return frames in the form that kernels read: (n, h, w), contiguous, uint16 or float32."""
    if array.dtype in KERNEL_TYPES and array.flags.c_contiguous and array.dtype.isnative:
        return array if array.ndim == 3 else array[None]
    dtype = np.uint16 if array.dtype == np.uint8 else np.float32
    with np.errstate(over="ignore"):  # values that overflow float32 become infinite: bad pixels
        frames = np.ascontiguousarray(array, dtype=dtype)
    return frames.reshape(-1, *array.shape[-2:])


class Plan:
    """Settings of each sub-aperture and tables of the estimator, for each level of flux that occurs.

    Parameters
    ----------
    layout, settings, calibration, psf, weights
        As for `SlopePipeline`.
    zero : (n, 2) array
        Reference positions, px from the window centres.
    width : int
        Number of SIMD lanes.

    Raises
    ------
    InputError
        If the parts are inconsistent.
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        calibration: Calibration,
        psf: PSF | None,
        weights: FixedWeights | None,
        zero: Floats,
        width: int,
    ) -> None:
        n, pixels = len(layout), layout.pixels

        def per_subaperture(name: str) -> NDArray[np.generic]:
            return settings.values(name, n, pixels)

        search = per_subaperture("search_range_px").astype(np.float64)
        self.sensor = Sensor(
            layout,
            calibration,
            psf,
            weights,
            zero,
            np.where(np.isnan(search), np.inf, search),
            per_subaperture("flux_e").astype(np.float64),
            spot_fwhm_px(settings, n, pixels),
            width,
        )
        self.estimator: Estimator = settings.estimator
        self.estimator.check(self.sensor)
        kind = self.estimator.plan
        if kind is None:
            from faintspot.slopes.estimators.python import PythonPlan  # few estimators are in Python

            kind = PythonPlan
        self.prepared: EstimatorPlan = kind(self.estimator, self.sensor)
        self.variances: NDArray[np.float32] | None = None
        """Variance of each dark pixel for the kernel, if it differs: see `kernels.groups.Task`."""
        if self.sensor.has_noise_map:
            self.variances = _packed(self.prepared.pixel_variance[None], width)[:, :, 0]
        self.spot_fwhm_px = self._spot_fwhm(settings)
        """Width of each spot along x and y, (n, 2); NaN where unknown."""
        self.expected = self._expected()
        """Expected range of the spot positions; spots outside are flagged."""
        self.no_prior = np.zeros((1, 2, n), np.float32)
        """Prior used without predicted slopes: 0."""
        self._fixed = self._fixed_table(per_subaperture)
        self._levels: list[NDArray[np.float32]] = []
        self._variants: dict[int, int] = {}
        self._kernels: dict[object, Direct] = {}
        self._lock = threading.RLock()
        self._made: tuple[NDArray[np.float32], object, object] | None = None
        if not self.prepared.needs_flux:
            self._add(self.sensor.flux_e)

    @property
    def settings(self) -> NDArray[np.float32]:
        """Settings tables (n_variants, rows, n)."""
        return self._arguments()[0]

    @property
    def own_scratch(self) -> Any:
        """Function that allocates the scratch memory of the estimator's kernel."""
        return self._arguments()[2]

    @property
    def kernel(self) -> Direct:
        """Compiled function that measures groups."""
        return self._direct(self.prepared.kernel)

    @property
    def flux_kernel(self) -> Direct:
        """Compiled function that sums their flux."""
        return self._direct(self.prepared.flux_kernel)

    def _direct(self, kernel: object) -> Direct:
        if kernel not in self._kernels:
            self._kernels[kernel] = Direct(kernel)
        return self._kernels[kernel]

    def task(self, variants: NDArray[np.int64], prior: NDArray[np.float32] | None = None) -> Task:
        """Return the kernel's task for frames.

        Parameters
        ----------
        variants : (n_frames,) int64
            Settings table of each frame.
        prior : (1 or n_frames, 2, n) float32, optional
            Predicted slopes. Default: 0.
        """
        settings, tables, _ = self._arguments()
        predicted = self.no_prior if prior is None else prior
        return Task(settings, variants, predicted, tables, self.variances)

    def _arguments(self) -> tuple[NDArray[np.float32], object, object]:
        """Return settings, tables and scratch function, rebuilt only for a new flux level."""
        with self._lock:
            if self._made is None or len(self._made[0]) != len(self._levels):
                prepared = self.prepared
                self._made = np.stack(self._levels), prepared.tables, prepared.own_scratch
            return self._made

    def variants(self, flux_e: Floats) -> NDArray[np.int64]:
        """Return the variants for the given fluxes per sub-aperture; add those that are missing."""
        with np.errstate(invalid="ignore"):
            flux = np.clip(np.nan_to_num(flux_e, nan=1.0, posinf=_MOST_FLUX_E), 1.0, _MOST_FLUX_E)
        step = self.prepared.flux_step
        levels = np.rint(np.log(flux) / math.log(step)).astype(np.int64)
        with self._lock:  # several threads may measure frames with the same pipeline
            for level in np.unique(levels).tolist():
                if level not in self._variants:
                    self._add(np.full(self.sensor.n, step**level))
                    self._variants[level] = len(self._levels) - 1
        return np.array([self._variants[level] for level in levels.tolist()], np.int64)

    def _add(self, flux_e: Floats) -> None:
        """Add the settings table of a flux level."""
        table = self._fixed.copy()
        self.prepared.fill_flux(table, flux_e)
        self._levels.append(table)

    def _spot_fwhm(self, settings: Settings) -> Floats:
        """Return the widths of the spots that are stated, or for which the pixels to keep were chosen."""
        sensor = self.sensor
        if "keep_brightest" not in settings.declared() or is_auto(settings.keep_brightest):
            return sensor.spot_fwhm_px
        kept = settings.values("keep_brightest", sensor.n, sensor.pixels).astype(np.float64)
        of_kept = _FWHM_OF_KEPT * np.sqrt(kept)[:, None]
        return np.where(np.isnan(sensor.spot_fwhm_px), of_kept, sensor.spot_fwhm_px)

    @property
    def typical_fwhm_px(self) -> float | None:
        """Median width of the spots; None if unknown."""
        known = self.spot_fwhm_px[~np.isnan(self.spot_fwhm_px)]
        return float(np.median(known)) if known.size else None

    def _expected(self) -> Expected:
        """Return the expected positions; a spot is complete if half its width is inside the window."""
        sensor, layout = self.sensor, self.sensor.layout
        fwhm = np.where(np.isnan(self.spot_fwhm_px), 1.0, self.spot_fwhm_px)
        half = 0.5 * np.array(sensor.window[::-1])
        edge = np.where(fwhm < half, half - 0.5 * fwhm, np.inf)
        pitch = layout.pitch_px
        neighbours = neighbours_of(layout.cells, layout.geometry, diagonal=True)
        lanes = lanes_for(np.float32, sensor.width)
        return Expected(
            lanes,
            np.ascontiguousarray(sensor.zero.T, np.float32),
            np.ascontiguousarray(edge.T, np.float32),
            *lines_of(neighbours, lanes.width),
            continued(neighbours),
            np.float32(np.inf if pitch is None else min(LEAST_DIFFERENCE * pitch, LEAST_DIFFERENCE_PX)),
        )

    def _fixed_table(self, per_subaperture: Callable[[str], NDArray[Any]]) -> NDArray[np.float32]:
        """Return the settings that do not depend on the flux."""
        sensor = self.sensor
        table = np.zeros((self.prepared.setting_rows, sensor.n), np.float32)
        table[groups.ZERO_X], table[groups.ZERO_Y] = sensor.zero.T
        table[groups.RANGE] = sensor.search_range_px
        table[groups.MOST_BAD] = np.floor(per_subaperture("max_bad_fraction") * sensor.pixels)
        has_noise = sensor.calibration.read_noise_e is not None
        table[groups.VARIANCE] = self.prepared.variance if has_noise else -1.0
        table[groups.EXCESS], table[groups.ERROR_SCALE] = sensor.excess_noise, per_subaperture("error_scale")
        self.prepared.fill(table)
        return table


NO_STAGES = np.empty((0, 0, 0, 0), np.float32)


class FrameArguments(NamedTuple):
    """Arrays and numbers that kernels read and write for frames in fixed memory."""

    source: Source
    task: Task
    slopes: SlopeArrays
    stages: NDArray[np.float32]
    light_test: LightTest
    expected: Expected

    @property
    def groups(self) -> int:
        """Number of groups in all frames."""
        n_frames, n = len(self.task.variants), len(self.source.corners)
        return n_frames * int(-(-n // self.source.lanes.width))

    def measuring(self, start: int, stop: int, scratch: Scratch) -> tuple[Any, ...]:
        """Return the arguments of `groups.measure_groups` for a thread's groups."""
        return self.source, self.task, start, stop, scratch, self.slopes, self.stages

    def checking(self, scratch: NDArray[np.float32]) -> tuple[Any, ...]:
        """Return the arguments of `doubtful.check_slopes`."""
        return self.light_test, self.source.frames, self.slopes, self.expected, scratch


class SmallFrames:
    """Measurement of frames of one type, one at a time, in one thread; all memory is allocated once.

    Parameters
    ----------
    kernel : Direct
        Compiled function that measures groups, of settings that do not depend on the flux of each frame.
    arguments : FrameArguments
        Of a frame (1, h, w), into which each frame is copied.
    scratch : Scratch
        Memory of the thread.
    check : function
        Sets the flags that depend on all slopes; see `SlopePipeline.flag_doubtful`.
    layout : Layout
        Of the results.
    """

    def __init__(
        self,
        kernel: Direct,
        arguments: FrameArguments,
        scratch: Scratch,
        check: Callable[[], None],
        layout: Layout,
    ) -> None:
        self._frame = arguments.source.frames.array[0]
        self._slopes = [result[0] for result in arguments.slopes]
        self._kernel, self._check, self._layout = kernel, check, layout
        self._arguments = arguments.measuring(0, arguments.groups, scratch)

    def __call__(self, frame: NDArray[np.generic]) -> Slopes:
        """Measure a frame (h, w)."""
        np.copyto(self._frame, frame)
        self._kernel(*self._arguments)
        self._check()
        return Slopes(*[values.copy() for values in self._slopes], layout=self._layout)
