"""A pipeline some of whose stages are modules; the others are the built-in, compiled ones."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from faintspot.checks import real_array
from faintspot.errors import InputError
from faintspot.estimators.python import limit_slopes
from faintspot.flags import INVALID, SubapertureFlag
from faintspot.kernels import gravity, groups
from faintspot.pipeline import SlopePipeline
from faintspot.realtime.built_in import BuiltIn
from faintspot.realtime.frame_path import check_real_time
from faintspot.realtime.module_loading import STAGES, Module, StageFunction
from faintspot.realtime.module_trial import trial_frames, typical_frame
from faintspot.realtime.time_limit import call_within, one_line
from faintspot.sensor.layout import Layout
from faintspot.slopes import Slopes

TRIAL_LIMIT_S = 60.0  # a module may compile
_TIMED_CALLS = 10
_NO_LIGHT = int(SubapertureFlag.NO_LIGHT)
_TOO_MANY_BAD = int(SubapertureFlag.TOO_MANY_BAD_PIXELS)
_OF_POSITIONS = np.uint8(SubapertureFlag.NO_LIGHT | SubapertureFlag.AT_SEARCH_LIMIT)


class ModularPipeline:
    """Turns frames into slopes as a `SlopePipeline` does, with modules in place of some of its stages.

    Without modules slopes are those of the pipeline, bit for bit ("thresholded": to float32 rounding, where
    pixels are bad); so they are with a module that does what the built-in stage does, but for: iterations and
    the flags of the denoising, which a "denoise" module does not report; standard errors, which are
    propagated from the images that a "calibrate" or "denoise" module returned, and are infinite (not known)
    after a "background" or "centroid" module.

    Bad pixels, saturation and missing light are found and flagged as built in, also before a "calibrate"
    module. A sub-aperture for which a module returns what is not finite is flagged NO_LIGHT. Estimators that
    know the spot have no stages of their own for "denoise" and "background": modules there come before them.

    Parameters
    ----------
    pipeline : SlopePipeline
    modules : mapping of str to Module
        By stage. Their functions are made here, and tried on frames without light, with typical spots, with
        noise and of saturated pixels, in a thread that is given up after a minute.
    budget_s : float, optional
        Longest time that a typical frame may take. Default: any.

    Raises
    ------
    InputError
        When a module is refused: it raises an error, returns something of another shape or type or what is
        not finite, takes too long or does not return. Also when the pipeline's settings follow the light of
        each frame.
    """

    def __init__(
        self, pipeline: SlopePipeline, modules: Mapping[str, Module], *, budget_s: float | None = None
    ) -> None:
        check_real_time(pipeline)
        for stage, module in modules.items():
            if stage != module.stage:
                raise InputError(f"{title_of(module)}: expected one for {stage!r}")
        self.pipeline = pipeline
        self.modules = {stage: modules[stage] for stage in STAGES if stage in modules}
        """By stage, in the pipeline's order."""
        self._lock = threading.Lock()
        self._unusable, self._complaint = np.zeros(len(pipeline.layout), bool), ""
        self._functions = {
            stage: call_within(TRIAL_LIMIT_S, title_of(module), _made, module, pipeline)
            for stage, module in self.modules.items()
        }
        self._prepare_built_in()
        self.working = ""
        """The stage whose module was called last, or has returned what is not finite."""
        self.called_s = math.inf
        """When the function of a module was called that has not returned (`time.perf_counter`); else inf."""
        self.fault: str | None = None
        """Why a `ModularPath` has given it up for good."""
        self.took_s = dict.fromkeys(self.modules, 0.0)
        """How long each module's function took in the last frame, by stage."""
        if self.modules:
            titles = ", ".join(title_of(module) for module in self.modules.values())
            call_within(TRIAL_LIMIT_S, titles, self._try_out, budget_s)

    @property
    def slowest(self) -> str:
        """The stage whose module took longest in the last frame."""
        return max(self.took_s, key=lambda stage: self.took_s[stage])

    def __call__(self, frame: ArrayLike) -> Slopes:
        """Measure the slopes of one frame (h, w), in ADU.

        Raises
        ------
        InputError
            For a frame that is not real or not of the layout's shape, and when a module fails.
        """
        array = real_array("frame", frame)
        if array.shape != self.pipeline.layout.frame_shape:
            raise InputError(f"frame: expected shape {self.pipeline.layout.frame_shape}, got {array.shape}")
        dtype = np.uint16 if array.dtype in (np.uint8, np.uint16) else np.float32
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite: a bad pixel
            readable = np.ascontiguousarray(array, dtype)
        with self._lock:
            self.gather(readable, array.dtype)
            self.finish()
            return Slopes(*(getattr(self.slopes, field.name).copy() for field in fields(Slopes)))

    # In two steps, for one frame after the other ----------------------------------------------------

    def gather(self, frame: NDArray[Any], dtype: DTypeLike | None = None) -> None:
        """Take from a frame all that is needed; afterwards it may be overwritten.

        Parameters
        ----------
        frame : (h, w) uint16 or float32, contiguous
        dtype : dtype, optional
            Of the camera's pixels, which says at what value they saturate. Default: the frame's.
        """
        saturation = self.pipeline.calibration.saturation(np.dtype(frame.dtype if dtype is None else dtype))
        self._calibrated = self._first(frame, saturation)[groups.CALIBRATED]
        if "calibrate" in self.modules:
            self._raw = self.pipeline.layout.images(frame).astype(np.float32)

    def finish(self, *, explain: bool = False) -> str | None:
        """Measure what was gathered; `slopes` then holds the result, until the next frame.

        Parameters
        ----------
        explain : bool
            Whether to keep the denoised images.

        Returns
        -------
        str or None
            What is wrong with a module that returned what is not finite.

        Raises
        ------
        InputError
            When a module fails.
        """
        self._unusable[:], self._complaint = False, ""
        images = self._applied("calibrate", self._raw) if "calibrate" in self.modules else self._calibrated
        denoising: Slopes | None = None
        if "denoise" in self.modules:
            images = self._applied("denoise", images)
        elif self._middle is not None:
            images = self._middle(images)[groups.DENOISED]
            denoising = self._middle.slopes
        if explain and self.modules.keys() & {"denoise", "background"}:
            self.denoised = images.copy()
        largest = np.abs(images).max(axis=(1, 2)) if self._measures_light else None
        if "background" in self.modules:
            images = self._applied("background", images)
        stages = self._last(images)
        if explain and not self.modules.keys() & {"denoise", "background"}:
            self.denoised = stages[groups.DENOISED].copy()
        if denoising is not None:
            self.slopes.iterations[:] = denoising.iterations
            self.slopes.flags[:] |= denoising.flags & ~_OF_POSITIONS
        if largest is not None:
            floor = self._last.settings[gravity.FLOOR] * largest
            self.slopes.flags[~(self.slopes.flux > floor)] |= _NO_LIGHT
        if "centroid" in self.modules:
            self._take_positions(self._applied("centroid", stages[groups.BACKGROUND]))
        self._flag()
        return self._complaint or None

    # The parts --------------------------------------------------------------------------------------

    def _prepare_built_in(self) -> None:
        """Make the built-in stages: before the modules, between them and after them."""
        denoise, background, centroid = (stage in self.modules for stage in STAGES[1:])
        self._first = BuiltIn(self.pipeline, on_images=False, denoise=False, own_estimator=False)
        self._middle: BuiltIn | None = None
        if background and not denoise:
            middle = BuiltIn(self.pipeline, on_images=True)
            self._middle = middle if middle.denoises else None
        self._last = BuiltIn(
            self.pipeline,
            on_images=True,
            denoise=not (denoise or background),
            background=not background,
            own_estimator=not centroid,
        )
        # Built in, the light that is left is compared with the image before the background was taken off.
        self._measures_light = background and self._last.gravity
        self.slopes = self._last.slopes
        """Of the frame measured last; overwritten by the next one."""
        self.denoised = np.zeros((len(self.pipeline.layout), *self.pipeline.layout.window), np.float32)
        """Images (n, ny, nx) of the frame that was measured last with `explain`."""
        self._calibrated = self._raw = np.zeros((len(self.pipeline.layout), 0, 0), np.float32)

    def _applied(self, stage: str, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """What a module makes of images, checked; what is not finite becomes 0 and is noted."""
        title = title_of(self.modules[stage])
        if not self._complaint:
            self.working = stage
        begin = self.called_s = time.perf_counter()
        try:
            with np.errstate(all="ignore"):
                result = self._functions[stage](images)
            self.called_s, self.took_s[stage] = math.inf, time.perf_counter() - begin
            check_result(result, result_shape(stage, self.pipeline.layout))
        except BaseException as error:  # also what would end the process
            raise InputError(f"{title}: {one_line(error)}") from None
        with np.errstate(over="ignore"):
            checked = result.astype(np.float32, copy=False)
        bad = ~np.isfinite(checked).all(axis=tuple(range(1, checked.ndim)))
        if bad.any():
            checked = checked.copy()
            checked[bad] = 0.0
            self._unusable |= bad
            complaint = f"{title}: returned NaN or infinite for {bad.sum()} sub-apertures"
            self._complaint = self._complaint or complaint
        return checked

    def _take_positions(self, positions: NDArray[np.float32]) -> None:
        """Slopes of positions that a module has measured."""
        table, (ny, nx) = self._last.settings, self.pipeline.layout.window
        inside = np.all(np.abs(positions) <= np.array([0.5 * nx, 0.5 * ny], np.float32), axis=1)
        self.slopes.flags[~inside] |= _NO_LIGHT
        away = positions - table[groups.ZERO_X : groups.ZERO_X + 2].T
        self.slopes.x[:], self.slopes.y[:] = limit_slopes(away, table, self.slopes.flags).T

    def _flag(self) -> None:
        """Flag what the calibration has found and what modules returned; slope 0 where that is invalid."""
        slopes, found = self.slopes, self._first.slopes
        slopes.flags[self._unusable] |= _NO_LIGHT
        slopes.flags[:] |= found.flags & ~_OF_POSITIONS
        too_many = (found.flags & _TOO_MANY_BAD) != 0  # which says it all
        slopes.flags[too_many] = found.flags[too_many]
        slopes.bad_pixels[:] = found.bad_pixels
        invalid = (slopes.flags & INVALID) != 0
        slopes.x[invalid] = slopes.y[invalid] = 0.0
        unknown = slice(None) if self.modules.keys() & {"background", "centroid"} else invalid
        slopes.standard_error_x[unknown] = slopes.standard_error_y[unknown] = np.inf

    # The trial --------------------------------------------------------------------------------------

    def _try_out(self, budget_s: float | None) -> None:
        """Refuse modules that do not do what they must; afterwards everything is compiled."""
        for frame in trial_frames(self.pipeline):
            self.gather(frame)
            complaint = self.finish()
            if complaint is not None:
                raise InputError(f"{complaint} in a trial")
        if budget_s is None:
            return
        typical, shortest = typical_frame(self.pipeline), math.inf
        for _ in range(_TIMED_CALLS):
            begin = time.perf_counter()
            self.gather(typical)
            self.finish()
            shortest = min(shortest, time.perf_counter() - begin)
            if shortest <= budget_s:
                return
        slowest = self.slowest
        raise InputError(
            f"{title_of(self.modules[slowest])}: a frame takes {1e6 * shortest:.0f} us, "
            f"{1e6 * self.took_s[slowest]:.0f} us of it there; expected at most {1e6 * budget_s:.0f} us"
        )


def result_shape(stage: str, layout: Layout) -> tuple[int, ...]:
    """Return the shape of what a stage's function returns."""
    return (len(layout), 2) if stage == "centroid" else (len(layout), *layout.window)


def check_result(result: Any, shape: tuple[int, ...]) -> None:
    """Refuse what is no array of float32 or float64 of that shape.

    Raises
    ------
    InputError
        It does not name the module.
    """
    if not isinstance(result, np.ndarray) or result.dtype not in (np.float32, np.float64):
        kind = result.dtype if isinstance(result, np.ndarray) else type(result).__name__
        raise InputError(f"expected an array of float32 or float64, got {kind}")
    if result.shape != shape:
        raise InputError(f"expected shape {shape}, got {result.shape}")


def title_of(module: Module) -> str:
    """Return what errors call a module."""
    return f"module {module.name} ({module.stage})"


def _made(module: Module, pipeline: SlopePipeline) -> StageFunction:
    """The function of a module."""
    try:
        function = module.make(pipeline.layout, pipeline.settings)
    except BaseException as error:  # also what would end the process
        raise InputError(f"{title_of(module)}: make: {one_line(error)}") from None
    if not callable(function):
        raise InputError(
            f"{title_of(module)}: make: expected that it returns a function, got {type(function).__name__}"
        )
    return function
