"""Threads that measure parts of a frame in compiled code, without the GIL, and predicted slopes as priors."""

import math
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.kernels import streaming
from faintspot.slopes.kernels.ordered import load, store
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

SMALLEST_STD_PX, LARGEST_STD_PX = 1e-6, 1e4
"""Smallest and largest standard deviation of a prior [px]."""


class SlopePrior:
    """Predicted slopes and their uncertainty for each frame in turn, in fixed memory.

    Parameters
    ----------
    n : int
        Number of sub-apertures.
    largest_px : float
        Largest possible slope.

    Attributes
    ----------
    mean_px : (1, 2, n) float32
        Predicted slopes; 0 where there is no prediction.
    std_px : (n,) float64
        Standard deviation along each axis; NaN: unknown, so that the settings' `prior_std_px` applies.
    changes : int
        Number of changes of `std_px`.
    """

    def __init__(self, n: int, largest_px: float = math.inf) -> None:
        self.mean_px = np.zeros((1, 2, n), np.float32)
        self.std_px = np.full(n, np.nan)
        self.changes = 0
        self.largest_px = largest_px
        self._mean = self.mean_px.reshape(-1)
        self._std_px: Floats | None = None

    def forget(self) -> None:
        """Remove the prediction."""
        self._mean[:] = 0.0
        self._take_std(None)

    def expect(self, mean_px: Floats, std_px: Floats | None = None) -> None:
        """Set predicted slopes; values that no frame can have count as no prediction.

        Parameters
        ----------
        mean_px : (2 n,) array
        std_px : (2 n,) array, optional
            Standard deviations; the same array given again must hold the same values. Estimators have one
            width for both axes: the rms of both. A width outside `SMALLEST_STD_PX` to `LARGEST_STD_PX` counts
            as unknown.
        """
        self._mean[:] = 0.0
        np.copyto(self._mean, mean_px, where=np.abs(mean_px) <= self.largest_px, casting="same_kind")
        self._take_std(std_px)

    def _take_std(self, std_px: Floats | None) -> None:
        if std_px is self._std_px:
            return
        self._std_px = std_px
        self.changes += 1
        self.std_px[:] = np.nan
        if std_px is not None:
            x, y = std_px.reshape(2, -1)
            usable = np.minimum(x, y) >= SMALLEST_STD_PX
            usable &= np.maximum(x, y) <= LARGEST_STD_PX
            self.std_px[usable] = np.hypot(x[usable], y[usable]) / math.sqrt(2)


_LINE = 16  # int64 numbers from one cell to the next: no two share a cache line
_POSTED = 0
_STOP_CELL = 0

Task = Callable[[int], bool]
"""Function that does the share of one worker, numbered from 1; returns whether it was completed."""


class Workers:
    """Threads that do a task together with the caller, each its own share.

    While awake they poll, so that a task begins within a microsecond; `park` lets them sleep.

    Parameters
    ----------
    count : int
        Number of threads in addition to the caller's.
    cpus : sequence of int, optional
        Processors to pin them to, cyclically. Default: not pinned.
    """

    def __init__(self, count: int, cpus: Sequence[int] | None = None) -> None:
        self.count, self._cpus = count, list(cpus or ())
        self._cells = np.zeros((1 + count) * _LINE, np.int64)
        self._control = np.zeros(1, np.int64)
        self._completed = [False] * (1 + count)
        self._task: Task | None = None
        self._awake, self._closed = threading.Event(), False
        self._awake.set()
        self._threads = [self._started(number) for number in range(1, 1 + count)]

    def post(self, task: Task) -> None:
        """Start a task on all threads; call `wait` before the next one."""
        self._task = task
        store(self._cells, _POSTED, load(self._cells, _POSTED) + 1)

    def wait(self) -> bool:
        """Wait until all shares are done; return whether all were completed."""
        job = self._cells[_POSTED]
        for number in range(1, 1 + self.count):
            cell = number * _LINE
            streaming.wait_for_rows(self._cells, cell, cell + 1, job, 0, _NEVER, _STOP_CELL)
        return all(self._completed[1:])

    def park(self) -> None:
        """Let the threads sleep between two tasks."""
        self._awake.clear()
        self._control[_STOP_CELL] = 1

    def wake(self) -> None:
        """Wake the threads."""
        self._control[_STOP_CELL] = 0
        self._awake.set()

    def replace_dead(self) -> int:
        """Restart dead threads and abandon their shares; return how many. For any one other thread."""
        dead = [index for index, thread in enumerate(self._threads) if not thread.is_alive()]
        for index in dead:
            number = index + 1
            self._completed[number] = False
            store(self._cells, number * _LINE, load(self._cells, _POSTED))
            self._threads[index] = self._started(number)
        return len(dead)

    def close(self) -> None:
        """End the threads."""
        self._closed = True
        self.park()
        self._awake.set()
        for thread in self._threads:
            thread.join()

    def _started(self, number: int) -> threading.Thread:
        name = f"faintspot-worker-{number}"
        thread = threading.Thread(target=self._serve, args=(number,), name=name, daemon=True)
        thread.start()
        return thread

    def _serve(self, number: int) -> None:
        """Do the share of every task."""
        if self._cpus:
            with suppress(OSError):  # already reported for the caller's own processors
                os.sched_setaffinity(0, {self._cpus[number % len(self._cpus)]})
        cells = self._cells
        done = int(cells[number * _LINE])
        while not self._closed:
            if not streaming.wait_for_rows(cells, 0, 1, done + 1, 0, self._control, _STOP_CELL):
                self._awake.wait()
                continue
            task = self._task
            try:
                self._completed[number] = task is not None and task(number)
            except BaseException:  # it is replaced
                return
            done += 1
            store(cells, number * _LINE, done)


_NEVER = np.zeros(1, np.int64)
"""Cell that never ends a wait: shares are completed, or abandoned for a dead worker."""


@dataclass(frozen=True, eq=False)
class PipelineMaker:
    """Parts of a pipeline but its settings; other processes can be given it."""

    layout: Layout
    calibration: Calibration
    psf: PSF | None = None
    weights: FixedWeights | None = None
    reference: NDArray[Any] | None = None
    """Reference slopes, as for `SlopePipeline`."""

    def __post_init__(self) -> None:
        if self.layout.bin > 1:
            raise InputError(
                f"layout.bin = {self.layout.bin}: expected 1, the engine measures rows as they arrive; "
                "bin in the camera, or measure recorded frames with `faintspot slopes`"
            )

    def __call__(self, settings: Settings) -> SlopePipeline:
        """Return the pipeline with settings."""
        parts = self.layout, settings, self.calibration, self.reference
        return SlopePipeline(*parts, psf=self.psf, weights=self.weights)
