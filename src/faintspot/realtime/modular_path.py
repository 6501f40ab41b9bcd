"""The way of one frame through the engine with modules, which cannot hold up the engine for long."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from collections.abc import Sequence
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.kernels import streaming
from faintspot.realtime.frame_path import STOP_CELL, FramePath, Progress
from faintspot.realtime.modular import TRIAL_LIMIT_S, ModularPipeline, title_of
from faintspot.realtime.module_trial import typical_frame
from faintspot.realtime.time_limit import call_is_under_way, end_thread, one_line
from faintspot.slopes import Slopes

BUDGET_S = 1e-3
MOST_OVERRUNS = 3  # of the budget, one after the other
LONGEST_BUDGETS = 10  # after so many, a frame is not waited for any more;
_PATIENT_BUDGETS = 100  # unless it is not the module that holds it up


class ModularPath:
    """Measures frames with a `ModularPipeline`, for the engine: has the attributes and methods of FramePath.

    The whole frame is waited for; then modules run in a thread of their own. It is a fault when one raises an
    error or returns what is not usable, when modules take longer than the budget in three frames one after
    the other, or when one does not return within ten budgets: that frame and all later ones are measured by
    the built-in path, with no gap, and `fault` says why. Only time within modules counts, and none while
    another module is tried in the same process, which holds up all threads. A thread that does not return is
    left alone; one that runs Python code is asked to end.

    Parameters
    ----------
    modular : ModularPipeline
        For this path alone.
    slots : sequence of (h, w) arrays
        Where frames arrive: frame k in slot k % len(slots). uint16 or float32, contiguous.
    progress : Progress
    fallback : FramePath
        Of the same pipeline, slots and progress.
    budget_s : float
        Of all modules together, for a frame.
    """

    def __init__(
        self,
        modular: ModularPipeline,
        slots: Sequence[NDArray[Any]] | NDArray[Any],
        progress: Progress,
        fallback: FramePath,
        *,
        budget_s: float = BUDGET_S,
    ) -> None:
        self.pipeline, self.modular = modular.pipeline, modular
        self.fault: str | None = modular.fault
        """Why modules are not used any more."""
        self.faulty_stage: str | None = None
        """Whose module that is about."""
        self._slots, self._progress, self._fallback = slots, progress, fallback
        self._budget_s, self._overruns = budget_s, 0
        layout = self.pipeline.layout
        self._rows = int(layout.corners[:, 0].max()) + layout.window[0]
        self._control = np.zeros(1, np.int64)
        self.slopes: Slopes = modular.slopes if self.fault is None else fallback.slopes
        """Of the frame measured last; overwritten by the next one."""
        self._requests: SimpleQueue[bool | None] = SimpleQueue()
        self._replies: SimpleQueue[str | None] = SimpleQueue()
        self._thread = threading.Thread(
            target=_serve,
            args=(modular, self._requests, self._replies),
            name="faintspot-modules",
            daemon=True,
        )
        self._thread.start()
        weakref.finalize(self, self._requests.put, None)  # ends the thread

    @property
    def denoised(self) -> NDArray[np.float32]:
        """Denoised images of the frame that was measured last with its stages, (n, ny, nx)."""
        return self.modular.denoised if self.fault is None else self._fallback.denoised

    @property
    def stopped(self) -> bool:
        """Whether waiting for rows has been ended."""
        return bool(self._control[STOP_CELL])

    @property
    def prior_std_px(self) -> NDArray[np.float64] | None:
        """How wide the prior is that slopes are drawn to: modules have none."""
        return None if self.fault is None else self._fallback.prior_std_px

    def await_start(self, number: int) -> None:
        """Wait for the first row of a frame; see `FramePath.await_start`."""
        self._fallback.await_start(number)

    def warm_up(self) -> None:
        """Measure a frame with typical spots, so that everything is compiled and in the caches."""
        self._fallback.warm_up()
        if self.fault is not None:
            return
        cells = np.zeros_like(self._progress.cells)
        cells.flat[self._progress.frame_cell] = 1
        self._wait(cells, 0)
        dtype = self._slots[0].dtype
        frame = typical_frame(self.pipeline).clip(0, 65535).astype(dtype)
        complaint = self._complaint(frame, True, TRIAL_LIMIT_S / self._budget_s)
        self._overruns = 0
        if complaint is not None:
            self._give_up(complaint, self.modular.working)

    def measure(self, number: int, slot: int | None = None, *, explain: bool = False) -> bool:
        """Measure a frame, waiting for its rows; see `FramePath.measure`."""
        if self.fault is not None:
            return self._fallback.measure(number, slot, explain=explain)
        if not self._wait(self._progress.cells, number):
            return False
        place = number % len(self._slots) if slot is None else slot
        complaint = self._complaint(self._slots[place], explain, LONGEST_BUDGETS)
        if complaint is not None:
            self._give_up(complaint, self.modular.working)
        elif self._overruns >= MOST_OVERRUNS:
            slowest = self.modular.slowest
            title, spent_s = title_of(self.modular.modules[slowest]), self.modular.took_s[slowest]
            late = (
                f"{MOST_OVERRUNS} frames in a row took longer than {1e6 * self._budget_s:.0f} us in modules"
            )
            self._give_up(f"{title}: {late}, the last one {1e6 * spent_s:.0f} us in this one", slowest)
        else:
            return True
        return self._fallback.measure(number, slot, explain=explain)

    def stop(self) -> None:
        """End all waiting for rows, now and in future; from any thread."""
        self._control[STOP_CELL] = 1
        self._fallback.stop()

    def go_on(self) -> None:
        """Wait for rows again."""
        self._control[STOP_CELL] = 0
        self._fallback.go_on()

    def _wait(self, cells: NDArray[np.int64], number: int) -> bool:
        """Wait for the rows of a frame, in compiled code without Python's lock."""
        there: bool = streaming.wait_for_rows(
            cells,
            self._progress.frame_cell,
            self._progress.rows_cell,
            number,
            self._rows,
            self._control,
            STOP_CELL,
        )
        return there

    def _complaint(self, frame: NDArray[Any], explain: bool, budgets: float) -> str | None:
        """Measure a frame that is there; return what went wrong with the modules."""
        begin = time.monotonic()
        self.modular.gather(frame)  # here, so that the modules' thread never reads shared memory
        self._requests.put(explain)
        try:
            complaint = self._reply(budgets)
        except Empty:
            end_thread(self._thread)
            title = title_of(self.modular.modules[self.modular.working])
            return f"{title}: did not return within {1e3 * (time.monotonic() - begin):.0f} ms"
        if sum(self.modular.took_s.values()) <= self._budget_s:
            self._overruns = 0
        elif not call_is_under_way():
            self._overruns += 1
        return complaint

    def _reply(self, budgets: float) -> str | None:
        """Wait for what the modules' thread says; longer where it is held up by others."""
        longest_s = timeout_s = budgets * self._budget_s
        end = time.perf_counter() + _PATIENT_BUDGETS * self._budget_s
        while True:
            try:
                return self._replies.get(timeout=timeout_s)
            except Empty:
                now = time.perf_counter()
                stuck = now - self.modular.called_s >= longest_s and not call_is_under_way()
                if stuck or now > end:
                    raise
                timeout_s = self._budget_s

    def _give_up(self, fault: str, stage: str) -> None:
        """From now on the built-in path measures."""
        self.faulty_stage, self.slopes = stage, self._fallback.slopes
        self.fault = self.modular.fault = fault
        self._requests.put(None)


def _serve(
    modular: ModularPipeline, requests: SimpleQueue[bool | None], replies: SimpleQueue[str | None]
) -> None:
    """The modules' thread: a request says whether to keep images, None that it is over.

    It has no real-time priority, with which a module that does not return would keep a processor for good.
    """
    with contextlib.suppress(OSError, AttributeError):  # not on every system
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    while (explain := requests.get()) is not None:
        try:
            replies.put(modular.finish(explain=explain))
        except InputError as error:
            replies.put(str(error))
        except BaseException as error:  # SystemExit also from `end_thread`
            replies.put(one_line(error))
