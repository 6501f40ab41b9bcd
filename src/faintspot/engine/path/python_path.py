"""Frame path for an estimator in NumPy, which runs in its own thread and cannot stall the engine."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.engine.path.frame_path import FramePath, check_real_time
from faintspot.engine.path.time_limit import call_is_under_way, end_thread
from faintspot.engine.path.trial_frames import trial_frames, typical_frame
from faintspot.slopes.estimators.base import Positions
from faintspot.slopes.estimators.python import PythonPlan
from faintspot.slopes.kernels.driver.groups import CALIBRATED
from faintspot.slopes.kernels.driver.products import ProductPart
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

BUDGET_S = 1e-3
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

    def __init__(
        self, pipeline: SlopePipeline, *arguments: Any, budget_s: float = BUDGET_S, **options: Any
    ) -> None:
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
        """Measure a frame, waiting for its rows; see `FramePath.measure`. No product is begun."""
        if not super().measure(number, slot, explain=True, **waiting):
            return False
        result = self._find_positions() if self.fault is None else self.fault
        self.failed = isinstance(result, str)
        positions = None if isinstance(result, str) else result
        self._prepared.write(positions, self._wide.settings, 0, self._results)
        return True

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
