"""Frame path for an estimator in NumPy, which is tried first and cannot stall the engine."""

import contextlib
import ctypes
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.engine.frames.frame_path import FramePath, check_real_time
from faintspot.slopes.estimators.base import Positions
from faintspot.slopes.estimators.python import PythonPlan
from faintspot.slopes.estimators.registry import one_line
from faintspot.slopes.kernels.groups import CALIBRATED
from faintspot.slopes.kernels.products import ProductPart
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

Result = TypeVar("Result")
_TRIAL = "faintspot-trial"


def call_within(limit_s: float, name: str, function: Callable[..., Result], *arguments: object) -> Result:
    """Call a function in a thread of its own and return what it returns.

    Parameters
    ----------
    limit_s : float
        Time limit; a call that exceeds it is abandoned and its thread asked to end, see `end_thread`.
    name : str
        Subject of the error message.

    Raises
    ------
    InputError
        When the time is over, or the function raises an exception that would end the process or the thread,
        such as SystemExit. Other exceptions are passed on.
    """
    replies: SimpleQueue[tuple[Result | None, BaseException | None]] = SimpleQueue()

    def work() -> None:
        try:
            replies.put((function(*arguments), None))
        except BaseException as error:  # pass any exception to the caller
            replies.put((None, error))

    thread = threading.Thread(target=work, name=_TRIAL, daemon=True)
    thread.start()
    try:
        result, error = replies.get(timeout=limit_s)
    except Empty:
        end_thread(thread)
        raise InputError(f"{name}: did not return within {limit_s:g} s") from None
    if isinstance(error, Exception):
        raise error
    if error is not None:
        raise InputError(f"{name}: {one_line(error)}")
    return result  # type: ignore[return-value]


def call_is_under_way() -> bool:
    """Return whether a `call_within` is running in this process: it may compile and delay other threads.

    An abandoned call counts until its thread has ended.
    """
    return any(thread.name == _TRIAL for thread in threading.enumerate())


def end_thread(thread: threading.Thread) -> None:
    """Ask an abandoned thread to end; Python code ends at its next step.

    Otherwise an endless loop would keep taking turns with all other threads. Compiled code is not
    interrupted.
    """
    if thread.ident is not None:
        identifier, exception = ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(identifier, exception)


_FLUX_E = 300.0
_NOISE_E = 3.0
_SATURATED_ADU = 65535.0  # if the detector's saturation is not known


def trial_frames(pipeline: SlopePipeline) -> list[NDArray[np.float32]]:
    """Return frames (h, w) in ADU: without flux, with typical spots, of noise, of saturated pixels.

    The frames are the same each time.
    """
    calibration = pipeline.calibration
    dark, scale = _dark_and_scale(pipeline)
    noise = _NOISE_E * np.random.default_rng(1503).standard_normal(dark.shape)
    level = _SATURATED_ADU if calibration.saturation_adu is None else calibration.saturation_adu
    frames_adu = dark, dark + noise / scale, np.full_like(dark, level)
    return [typical_frame(pipeline), *(frame.astype(np.float32) for frame in frames_adu)]


def typical_frame(pipeline: SlopePipeline) -> NDArray[np.float32]:
    """Return a frame (h, w) in ADU with a spot in every sub-aperture and read noise; the same each time."""
    from faintspot.slopes.simulate import Detector, sensor_frames  # estimators in NumPy alone are tried

    electrons, _ = sensor_frames(
        pipeline.layout,
        1,
        flux_e=_FLUX_E,
        position_range_px=0.5,
        detector=Detector(read_noise_e=_NOISE_E),
        rng=np.random.default_rng(2015),
    )
    dark, scale = _dark_and_scale(pipeline)
    return np.asarray(dark + electrons[0] / scale, np.float32)


def _dark_and_scale(pipeline: SlopePipeline) -> NDArray[np.float32]:
    """Return dark (ADU) and electrons per ADU of every pixel, treating bad pixels like good ones."""
    maps = pipeline.calibration.maps(pipeline.layout.frame_shape)
    maps[0], maps[1] = np.nan_to_num(maps[0]), np.nan_to_num(maps[1], nan=1.0, posinf=1.0)
    return maps


MOST_FAILURES = 3  # consecutive frames that fail or exceed the budget
LONGEST_BUDGETS = 10  # longest wait for a frame, in budgets
_PATIENT_BUDGETS = 100  # the same while a trial delays all threads
_TIMED_CALLS = 10

Found = Positions | str
"""Positions, or the error message of a frame in which the estimator failed."""


class PythonPath(FramePath):
    """Measurement of frames with an estimator in NumPy, which runs in its own thread.

    A frame in which the estimator fails is flagged: all its slopes are invalid. If three consecutive frames
    fail or exceed the budget, or the estimator does not return within ten budgets, `fault` is set and all
    later frames are flagged. Its thread is then asked to end.

    Parameters
    ----------
    pipeline : SlopePipeline
        Pipeline with an estimator that has `locate`.
    *arguments, **options
        As for `FramePath`.
    budget_s : float
        Time limit of the estimator for one frame.
    """

    def __init__(self, pipeline: SlopePipeline, *arguments: Any, budget_s: float, **options: Any) -> None:
        super().__init__(pipeline, *arguments, **options)
        prepared = pipeline.plan.prepared
        if not isinstance(prepared, PythonPlan):
            raise TypeError(f"{pipeline.settings.estimator.name} is compiled: expected a FramePath")
        self._prepared, self._budget_s, self._failures = prepared, budget_s, 0
        self._images = self._stages[CALIBRATED, 0].reshape(-1, *pipeline.layout.window)
        self._requests: SimpleQueue[NDArray[np.float64] | None] = SimpleQueue()
        self._replies: SimpleQueue[tuple[Found, float]] = SimpleQueue()
        self._thread = threading.Thread(
            target=_serve,
            args=(prepared, self._images, self._requests, self._replies),
            name="faintspot-estimator",
            daemon=True,
        )
        self._thread.start()
        weakref.finalize(self, self._requests.put, None)  # ends the thread

    def measure(
        self,
        number: int,
        slot: int | None = None,
        *,
        explain: bool = False,
        product: Sequence[ProductPart] = (),
        **waiting: Any,
    ) -> bool:
        """Calibrate a frame, waiting for its rows; see `FramePath.measure`. No product is begun."""
        return super().measure(number, slot, explain=True, **waiting)

    def locate(self) -> None:
        """Let the estimator find the positions in the frame that was calibrated last."""
        result = self._find_positions() if self.fault is None else self.fault
        self.failed = isinstance(result, str)
        positions = None if isinstance(result, str) else result
        self._prepared.write(positions, self._wide.settings, 0, self._results)

    def _find_positions(self) -> Found:
        """Get the positions from the estimator's thread; set `fault` when the estimator is disabled."""
        zero, prior = self._prepared.sensor.zero, self._prior
        self._requests.put(zero.copy() if prior is None else zero + prior.mean_px[0].T)
        begin = time.perf_counter()
        try:
            result, took_s = self._reply(begin)
        except Empty:
            end_thread(self._thread)
            spent_ms = 1e3 * (time.perf_counter() - begin)
            return self._disabled(f"{_title(self.pipeline)}: did not return within {spent_ms:.0f} ms")
        late = took_s > self._budget_s and not call_is_under_way()
        self._failures = self._failures + 1 if late or isinstance(result, str) else 0
        if self._failures >= MOST_FAILURES:
            reason = result if isinstance(result, str) else _too_slow(self.pipeline, took_s, self._budget_s)
            self._disabled(f"{reason}; {MOST_FAILURES} frames in a row failed or were late")
        return result

    def _disabled(self, fault: str) -> str:
        self._requests.put(None)
        self.fault = fault
        return fault

    def _reply(self, begin: float) -> tuple[Found, float]:
        """Wait for the result of the estimator's thread; wait longer while a trial delays all threads."""
        timeout_s, end = LONGEST_BUDGETS * self._budget_s, begin + _PATIENT_BUDGETS * self._budget_s
        while True:
            try:
                return self._replies.get(timeout=timeout_s)
            except Empty:
                if not call_is_under_way() or time.perf_counter() > end:
                    raise
                timeout_s = self._budget_s


def tried(
    make_pipeline: Callable[[Settings], SlopePipeline], settings: Settings, budget_s: float = math.inf
) -> SlopePipeline:
    """Return a pipeline after measuring trial frames: without flux, with spots, of noise, and saturated.

    Raises
    ------
    InputError
        When the settings do not fit, the estimator fails, or each of ten typical frames takes it longer than
        the budget.
    """
    pipeline = make_pipeline(settings)
    check_real_time(pipeline)
    prepared = pipeline.plan.prepared
    for frame in trial_frames(pipeline):
        pipeline(frame)
        if prepared.faults:
            raise InputError(prepared.fault)
    if not isinstance(prepared, PythonPlan):
        return pipeline
    images = pipeline.explain(typical_frame(pipeline)).calibrated
    shortest_s = math.inf
    for _ in range(_TIMED_CALLS):
        begin = time.perf_counter()
        prepared.found(images.copy(), prepared.sensor.zero.copy())
        shortest_s = min(shortest_s, time.perf_counter() - begin)
        if shortest_s <= budget_s:
            return pipeline
    raise InputError(_too_slow(pipeline, shortest_s, budget_s))


def _title(pipeline: SlopePipeline) -> str:
    return f"estimator {pipeline.settings.estimator.name!r}"


def _too_slow(pipeline: SlopePipeline, took_s: float, budget_s: float) -> str:
    return f"{_title(pipeline)}: expected at most {1e6 * budget_s:.0f} us a frame, got {1e6 * took_s:.0f}"


def _serve(
    prepared: PythonPlan,
    images: NDArray[np.float32],
    requests: SimpleQueue[NDArray[np.float64] | None],
    replies: SimpleQueue[tuple[Found, float]],
) -> None:
    """Find the positions in the images for each request (the predicted positions); None ends the thread.

    It runs without real-time priority: otherwise an estimator that does not return would block a processor.
    """
    with contextlib.suppress(OSError, AttributeError):  # not available on every system
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    while (prior := requests.get()) is not None:
        begin = time.perf_counter()
        try:
            result: Found = prepared.found(images, prior)
        except InputError as error:
            result = str(error)
        replies.put((result, time.perf_counter() - begin))
