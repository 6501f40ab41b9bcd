"""Slope pipeline: frame -> calibration -> estimator -> slopes."""

from __future__ import annotations

import copy
import hashlib
import math
import threading
from collections.abc import Callable
from dataclasses import fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from faintspot.base.checks import check_shape, number_between, numbers_between, real_array
from faintspot.base.errors import InputError
from faintspot.base.flags import scaled_positions
from faintspot.slopes.camera.calibration import Calibration, binned, binned_calibration, spread
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.kernels.compiling import Direct
from faintspot.slopes.kernels.gather import Frames
from faintspot.slopes.kernels.groups import (
    CALIBRATED,
    STAGE_ROWS,
    Scratch,
    SlopeArrays,
    Source,
    Task,
    new_scratch,
)
from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.parallel import most_threads, run_groups, thread_scratch
from faintspot.slopes.kernels.simd import Lanes
from faintspot.slopes.kernels.validity.dark import scratch_size
from faintspot.slopes.kernels.validity.doubtful import check_slopes, doubtful_scratch_size
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.light import MeanFlux, MeanLight, light_test
from faintspot.slopes.pipeline.plan import (
    KERNEL_TYPES,
    NO_STAGES,
    FrameArguments,
    Plan,
    SmallFrames,
    kernel_frames,
    packed_calibration,
)
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes, Stages, prior_slopes, reference_positions
from faintspot.slopes.sensor.binning import binned_layout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

_SMALL_TYPES = (np.dtype(np.uint8), *KERNEL_TYPES)
_FLUX_COST = 0.1  # of summing the pixels of a sub-aperture, in units of `Estimator.cost`


class SlopePipeline:
    """Computes slopes from frames.

    Parameters
    ----------
    layout : Layout
    settings : Settings or Estimator
    calibration : Calibration, optional
        Default: frames are already in electrons.
    reference : array or Slopes, optional
        Reference positions, px from the centre of each sub-aperture, which are subtracted from all
        positions: (n, 2) x and y, or (2 n,) all x then all y, or the slopes of one frame. Their magnitude
        must not exceed the longer side of the frame. Default: 0.
    psf : PSF, optional
        Required by estimators that use the spot shape; it provides the spot width to others.
    weights : FixedWeights, optional
        Fixed weights of a window.
    width : int, optional
        SIMD width in float32 numbers: 4, 8 or 16. Default: the width of the machine.
    threads : int, optional
        Maximum number of threads. Default: all available processors. Slopes do not depend on it.

    Raises
    ------
    InputError
        If the parts are inconsistent.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    >>> frames, truth = fs.slopes.simulate.sensor_frames(
    ...     layout, 20, flux_e=200.0, rng=np.random.default_rng(1)
    ... )
    >>> pipeline = fs.SlopePipeline(layout, fs.Settings(noise_std=0.5, keep_brightest=12))
    >>> slopes = pipeline(frames)
    >>> slopes.x.shape
    (20, 36)
    >>> print(f"mean error {np.abs(slopes.x - truth[..., 0]).mean():.2f} px")
    mean error 0.05 px
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings | Estimator,
        calibration: Calibration | None = None,
        reference: ArrayLike | Slopes | None = None,
        *,
        psf: PSF | None = None,
        weights: FixedWeights | None = None,
        width: int | None = None,
        threads: int | None = None,
    ) -> None:
        self.layout = layout
        self.binned_layout = binned_layout(layout)
        """Layout in the pixels of binned frames, in which slopes are measured: `layout` if its `bin` is 1."""
        self.settings = Settings(settings) if isinstance(settings, Estimator) else settings
        self.calibration = Calibration() if calibration is None else calibration
        if threads is not None:
            threads = int(number_between("threads", threads, 1, 4096, integer=True))
        self.threads = threads
        self._lanes = lanes_for(np.float32, width)
        self._parts = psf, weights, layout.offsets + reference_positions(reference, layout)
        self._prepare()

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> SlopePipeline:
        """Make the pipeline described by a configuration file (faintspot.toml)."""
        described = configuration.Configuration(path)
        options |= described.spot
        return cls(described.layout, described.settings, described.calibration, **options)

    def _prepare(self) -> None:
        """Compute the tables for the current SIMD width; forget what was prepared for small frames."""
        self._small = threading.local()
        width, factor = self._lanes.width, self.layout.bin
        psf, weights, zero = self._parts
        settings, calibration = self.binned_parts
        maps = calibration.maps(self.binned_layout.frame_shape)
        self._calibration = packed_calibration(self.binned_layout, maps, width)
        self.plan = Plan(self.binned_layout, settings, calibration, psf, weights, zero / factor, width)
        """Settings and tables computed before the first frame."""
        self.light_test = light_test(self.binned_layout, maps, self.plan.typical_fwhm_px)
        """Test for sub-apertures without flux."""
        sizes = scratch_size(*self.binned_layout.window), doubtful_scratch_size(len(self.layout))
        self._check_scratch_size = max(sizes)

    @property
    def width(self) -> int:
        """Number of sub-apertures measured at once."""
        return self._lanes.width

    def with_width(self, width: int) -> SlopePipeline:
        """Return the same pipeline with another SIMD width: 4, 8 or 16. Slopes do not depend on it.

        Raises
        ------
        InputError
            If the width is another one.
        """
        return self._changed(_lanes=lanes_for(np.float32, width))

    def _changed(self, **attributes: object) -> SlopePipeline:
        """Return a copy with other attributes, whose tables are computed anew."""
        pipeline = copy.copy(self)
        vars(pipeline).update(attributes)
        pipeline._prepare()
        return pipeline

    @property
    def binned_parts(self) -> tuple[Settings, Calibration]:
        """Settings and calibration in the pixels of `binned_layout`."""
        if self.layout.bin == 1:
            return self.settings, self.calibration
        calibration = binned_calibration(self.calibration, self.layout.bin, self.layout.frame_shape)
        return self.settings.magnified(1 / self.layout.bin), calibration

    @property
    def spot(self) -> tuple[PSF | None, FixedWeights | None]:
        """PSF and weights of the pipeline."""
        return self._parts[:2]

    def with_settings(self, settings: Settings) -> SlopePipeline:
        """Return the same pipeline with other settings.

        Raises
        ------
        InputError
            If they do not fit the sensor.
        """
        return self._changed(settings=settings)

    def with_flux(self, mean_flux: MeanFlux | ArrayLike) -> SlopePipeline:
        """Return the same pipeline with the given mean flux of its sub-apertures.

        If `flux_e` is not set, estimators that use the flux measure it in every frame, which is less
        precise for faint frames. Flux is quantised in steps of a few per cent. If it has not changed by a
        step, this pipeline itself is returned, so that the method may be called in every frame.

        Parameters
        ----------
        mean_flux : MeanFlux, or float or (n,) array
            Flux of a frame [electrons].

        Raises
        ------
        InputError
            If flux is not positive, or the number of sub-apertures differs.
        """
        flux_e = mean_flux.positive_flux_e if isinstance(mean_flux, MeanFlux) else mean_flux
        flux_e = numbers_between("mean_flux", flux_e, 0.0, 1e12, low_open=True)
        if flux_e.shape not in ((), (len(self.layout),)):
            raise InputError(
                f"mean_flux: expected one number or {len(self.layout)}, got shape {flux_e.shape}"
            )
        step = math.log(self.plan.prepared.flux_step)
        planned_e = self.plan.sensor.flux_e
        with np.errstate(divide="ignore", invalid="ignore"):
            steady = np.abs(np.log(flux_e / planned_e)) <= step
        if steady.all():
            return self
        rounded = np.exp(step * np.rint(np.log(flux_e) / step))
        return self.with_settings(self.settings.replace(flux_e=np.broadcast_to(rounded, planned_e.shape)))

    def with_dark(self, mean: NDArray[np.generic]) -> SlopePipeline:
        """Return the same pipeline for frames of this mean: what has no flux in it is dark in all of them.

        A single frame shows which sub-apertures are dark only if its spots are bright. The mean of all frames
        shows it for faint stars, and for none at all.

        Parameters
        ----------
        mean : (h, w) array
            Mean of the frames [ADU]; NaN in pixels without any value.
        """
        if self.layout.bin > 1:
            mean = binned(mean, self.layout.bin)
        light = MeanLight(self.binned_layout, self.light_test.maps, self.plan.typical_fwhm_px)
        dark = np.flatnonzero(light.significances(mean) < 1.0)
        other = copy.copy(self)
        other._small, other.light_test = threading.local(), self.light_test._replace(dark=dark)
        return other

    def for_images(self) -> SlopePipeline:
        """Return the same pipeline for calibrated images (n, ny, nx) [electrons], read as one tall frame."""
        layout, camera = self.layout, self.calibration
        if layout.bin > 1:
            raise InputError(f"layout.bin = {layout.bin}: expected frames, which are binned; images are not")
        noise: object = camera.read_noise_e
        if self.plan.sensor.has_noise_map:
            noise = (self.plan.sensor.pixel_noise_e * camera.em_gain).reshape(-1, layout.window[1])
        stacked = Layout.stacked(len(layout), layout.window, layout.offsets)
        calibration = Calibration(
            dark=None if camera.dark is None else 0.0,
            estimated=camera.estimated,
            gain_e_per_adu=camera.em_gain,
            em_gain=camera.em_gain,
            read_noise_e=noise,
            background_e=camera.background_e,
        )
        return self._changed(layout=stacked, binned_layout=stacked, calibration=calibration)

    @property
    def needs_flux(self) -> bool:
        """Whether settings follow the flux of each frame, which is measured first."""
        return self.plan.prepared.needs_flux

    def fingerprint(self) -> bytes:
        """Return bytes that identify the pipeline: they differ if slopes of the same frame may differ."""
        parts = [self.layout.corners, self.calibration.maps(self.layout.frame_shape)]
        if self.plan.sensor.has_noise_map:
            parts.append(self.plan.sensor.pixel_noise_e)
        calibration = self.calibration
        text = (
            f"{self.layout.window} {self.layout.bin} {calibration.saturation_adu} "
            f"{calibration.read_noise_photoelectrons} {calibration.background_e} {calibration.em_gain} "
            f"{calibration.dark_is_known} {configuration.to_text(self.settings)}"
        )
        return (
            b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
            + _identity(*self._parts)
            + text.encode()
        )

    def __call__(self, frame: ArrayLike, prior: ArrayLike | Slopes | None = None) -> Slopes:
        """Measure the slopes of a frame (h, w) or of frames (n, h, w), in ADU.

        NaN and infinite pixels are treated as bad pixels; a sub-aperture that cannot be measured is flagged.

        Parameters
        ----------
        frame : array
        prior : array or Slopes, optional
            Predicted slopes [px], used by "map" (mean of the prior): an
            array as for `reference`, or one such array per frame. Default: 0, which also replaces values
            that are not finite or exceed the longer side of the frame.

        Raises
        ------
        InputError
            If a frame is not real or does not have the layout's shape, or the prior has the wrong shape.
        """
        simple = prior is None and self.layout.bin == 1
        if simple and type(frame) is np.ndarray and frame.shape == self.layout.frame_shape:
            small = vars(self._small)
            if frame.dtype not in small:
                small[frame.dtype] = self._small_frames(frame.dtype)
            measure: SmallFrames | None = small[frame.dtype]
            if measure is not None:
                return measure(frame)
        return self._run(self.checked(frame), _camera_type(frame), prior, explain=False)[0]

    def _small_frames(self, dtype: np.dtype[np.generic]) -> SmallFrames | None:
        """Return the calling thread's own way to measure frames of a small sensor; None if it is not one."""
        plan, lanes, window = self.plan, self._lanes, self.layout.window
        groups = -(-len(self.layout) // lanes.width)
        simple = dtype in _SMALL_TYPES and not (self.needs_flux or plan.prepared.in_python)
        if not simple or most_threads(groups, lanes, window, plan.estimator.cost) > 1:
            return None
        frames = np.empty((1, *self.layout.frame_shape), np.float32 if dtype.kind == "f" else np.uint16)
        arguments = self.arguments(frames, dtype)
        scratch = thread_scratch(lanes, window, plan.own_scratch)
        return SmallFrames(plan.kernel, arguments, scratch, self.check(arguments), self.layout)

    def explain(self, frame: ArrayLike, prior: ArrayLike | Slopes | None = None) -> Stages:
        """Return the sub-aperture images after every step, for figures and for debugging.

        For estimators that use the calibrated image directly, the later images are equal to it.
        """
        array = self.checked(frame)
        slopes, stages = self._run(array, _camera_type(frame), prior, explain=True)
        stages = stages.reshape(3, *slopes.x.shape, *self.binned_layout.window)
        if self.layout.bin > 1:
            stages = spread(stages, self.layout.bin)
        calibrated, denoised, background = stages
        return Stages(self.layout.images(array), calibrated, denoised, background, slopes)

    def checked(self, frame: ArrayLike) -> NDArray[np.generic]:
        """Return one or several frames as an array; raise InputError if they do not fit the layout."""
        array = real_array("frame", frame, minimum_dimensions=2)
        check_shape("frame", array, self.layout.frame_shape, ("n", *self.layout.frame_shape))
        return array

    def _run(
        self,
        array: NDArray[np.generic],
        dtype: np.dtype[np.generic],
        prior: ArrayLike | Slopes | None,
        explain: bool,
    ) -> tuple[Slopes, NDArray[np.float32]]:
        """Compute the slopes, and the stages if requested."""
        factor = self.layout.bin
        if factor > 1:
            array = binned(array, factor, self.calibration.saturation(dtype))
        frames = kernel_frames(array)
        n_frames, n = len(frames), len(self.layout)
        prepared = self.plan.prepared
        stages = NO_STAGES
        if explain or prepared.in_python:
            stages = np.empty((STAGE_ROWS, n_frames, n, self.binned_layout.pixels), np.float32)
        predicted = None if prior is None else prior_slopes(prior, n_frames, self.layout) / np.float32(factor)
        task = self.plan.task(self._variants(frames, dtype), predicted)
        arguments = self.arguments(frames, dtype, task, stages=stages)
        kernel, results = self.plan.kernel, arguments.slopes

        def job(start: int, stop: int, scratch: Scratch) -> None:
            kernel(*arguments.measuring(start, stop, scratch))

        own_scratch = self.plan.own_scratch
        cost, window = self.plan.estimator.cost, self.binned_layout.window
        run_groups(job, arguments.groups, self._lanes, window, self.threads, own_scratch, cost)
        if prepared.in_python:
            images = stages[CALIBRATED].reshape(n_frames, n, *self.binned_layout.window)
            for f in range(n_frames):
                predicted_f = task.prior[min(f, len(task.prior) - 1)]
                prepared.locate_frame(images[f], predicted_f, task.settings[0], f, results)
        self.check(arguments)()
        if factor > 1:
            results = SlopeArrays(**scaled_positions(results._asdict(), factor))
        arrays = results if array.ndim == 3 else [result[0] for result in results]
        return Slopes(*arrays, layout=self.layout), stages

    def arguments(
        self,
        frames: NDArray[Any],
        dtype: DTypeLike,
        task: Task | None = None,
        *,
        slopes: SlopeArrays | None = None,
        stages: NDArray[np.float32] = NO_STAGES,
    ) -> FrameArguments:
        """Return the arguments of the compiled functions for frames in fixed memory.

        Parameters
        ----------
        frames, dtype
            As for `source`.
        task : Task, optional
            Default: the first settings table, without a prior.
        slopes : SlopeArrays, optional
            Results, (n_frames, n). Default: new memory.
        stages : (STAGE_ROWS or 0, n_frames, n, pixels) float32
            Images after every step.
        """
        if task is None:
            task = self.plan.task(np.zeros(len(frames), np.int64))
        if slopes is None:
            shape = len(frames), len(self.layout)
            slopes = SlopeArrays(*(np.empty(shape, kind) for kind in RESULT_TYPES))
        source = self.source(frames, dtype)
        return FrameArguments(source, task, slopes, stages, self.light_test, self.plan.expected)

    def new_scratch(self) -> Scratch:
        """Return the memory of one more thread that measures."""
        window = self.binned_layout.window
        return new_scratch(self._lanes, *window, self.plan.own_scratch(self._lanes, *window))

    def new_check_scratch(self) -> NDArray[np.float32]:
        """Return the memory of one more thread that sets the flags which need whole frames."""
        return np.empty(self._check_scratch_size, np.float32)

    def flag_doubtful(self, results: SlopeArrays, frames: NDArray[Any]) -> None:
        """Flag dark sub-apertures of bright frames, and spots cut by their window or unlike all neighbours.

        The flags need the slopes of whole frames; slopes can be used before they are set. Those of dark
        sub-apertures become 0.

        Parameters
        ----------
        results : SlopeArrays
            Slopes of the frames; changed.
        frames : (n, h, w) array, uint16 or float32, contiguous
        """
        self.check(self.arguments(frames, frames.dtype, slopes=results))()

    def check(self, arguments: FrameArguments) -> Callable[[], None]:
        """Return `flag_doubtful` for these arguments, to be called for all frames written to their memory."""
        kernel = _checks(self.light_test.lanes, self._lanes)
        return partial(kernel, *arguments.checking(self.new_check_scratch()))

    def source(self, frames: NDArray[np.generic], dtype: DTypeLike) -> Source:
        """Return the frames in the form that kernels read.

        Parameters
        ----------
        frames : (n, h, w) array, uint16 or float32, contiguous
        dtype : dtype
            Type of the camera's pixels, which sets their saturation level.
        """
        saturation = self.calibration.saturation(np.dtype(dtype)) * self.layout.bin**2
        corners, window = self.binned_layout.corners, self.binned_layout.window
        return Source(self._lanes, Frames.of(frames), corners, *window, self._calibration, saturation)

    def _variants(self, frames: NDArray[Any], dtype: DTypeLike) -> NDArray[np.int64]:
        """Return the index of the settings table of each frame, by its flux if settings depend on it."""
        n_frames, n = len(frames), len(self.layout)
        if not self.needs_flux:
            return np.zeros(n_frames, np.int64)
        source = self.source(frames, dtype)
        flux, flux_kernel = np.empty((n_frames, n), np.float32), self.plan.flux_kernel

        def job(start: int, stop: int, scratch: Scratch) -> None:
            flux_kernel(source, start, stop, scratch, flux)

        n_groups = n_frames * -(-n // self._lanes.width)
        run_groups(job, n_groups, self._lanes, self.binned_layout.window, self.threads, cost=_FLUX_COST)
        return self.plan.variants(flux.mean(axis=1, dtype=np.float64))


@cache
def _checks(pixels: Lanes, subapertures: Lanes) -> Direct:
    """Return `check_slopes` for so many pixels and sub-apertures at once."""
    return Direct(check_slopes)


def _camera_type(frame: ArrayLike) -> np.dtype[np.generic]:
    """Return the type of the frame's pixels as given: masked integers become floats later."""
    return frame.dtype if isinstance(frame, np.ndarray) else np.asarray(frame).dtype


def _identity(psf: PSF | None, weights: FixedWeights | None, zero: NDArray[np.float64]) -> bytes:
    """Return a digest of the inputs of slopes other than layout, settings and calibration."""
    digest = hashlib.sha256(zero.tobytes())
    for part in (psf, weights):
        for field in fields(part) if part is not None else ():
            value = getattr(part, field.name)
            content = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            digest.update(f"{type(part).__name__}.{field.name}".encode() + content)
    return digest.digest()
