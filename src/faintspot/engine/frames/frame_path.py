"""Measurement of one frame in the engine, with everything allocated in advance.

A frame path belongs to one pipeline, i.e. to one state of the settings. When settings change, another one is
prepared while the engine runs, and taken between two frames.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.engine.frames.workers import SlopePrior, Workers
from faintspot.loop.control.configuration import prior_std_px
from faintspot.slopes.kernels import streaming
from faintspot.slopes.kernels.compiling import Direct
from faintspot.slopes.kernels.groups import DENOISED, ERROR_SCALE, STAGE_ROWS, SlopeArrays
from faintspot.slopes.kernels.host import WIDTHS
from faintspot.slopes.kernels.products import NO_PRODUCT, ProductPart
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes

STOP_CELL = 0
Rehearsal = Callable[[], object]


@dataclass(frozen=True, eq=False)
class Progress:
    """Cells that show how much of a frame has arrived.

    Parameters
    ----------
    cells : int64 array
        Progress cells, in shared memory.
    frame_cell, rows_cell : int
        Indices of the arriving frame's number and of its number of complete rows.
    """

    cells: NDArray[np.int64]
    frame_cell: int
    rows_cell: int


class _Groups:
    """A range of a frame's groups of sub-apertures, with the arguments of their kernel.

    Parameters
    ----------
    pipeline, slots, prior
        As for `FramePath`.
    results : (SlopeArrays, array)
        Slopes, and images after every step.
    groups : (int, int)
        First group, and the one after the last.
    shares : int
        Number of shares into which the groups are divided.
    """

    def __init__(
        self,
        pipeline: SlopePipeline,
        slots: Sequence[NDArray[np.generic]] | NDArray[np.generic],
        results: tuple[SlopeArrays, NDArray[np.float32]],
        groups: tuple[int, int],
        shares: int,
        prior: SlopePrior | None,
    ) -> None:
        self._last_rows = last_rows_of_groups(pipeline, pipeline.width)
        first, count = groups[0], groups[1] - groups[0]
        starts = [first + count * share // shares for share in range(shares + 1)]
        self._ranges = [self._range(*ends) for ends in itertools.pairwise(starts)]
        task = pipeline.plan.task(np.zeros(1, np.int64), None if prior is None else prior.mean_px)
        task = task._replace(settings=task.settings.copy())
        self.settings: NDArray[np.float32] = task.settings[0]
        """Settings of every sub-aperture for the kernel: rows as in `kernels.groups`."""
        slopes, stages = results
        self.arguments = [pipeline.arguments(slot[None], slot.dtype, task, slopes=slopes) for slot in slots]
        """Arguments of the kernels for each slot."""
        self._explaining = [arguments._replace(stages=stages) for arguments in self.arguments]
        self._width, self._frame_rows = pipeline.width, int(last_rows_of_groups(pipeline, 1).max())
        self._stream = Direct(streaming.stream_groups)
        self._multiply = Direct(streaming.multiply_until)
        self._sleep = Direct(streaming.sleep_until_due)
        self._due = np.zeros(len(self._last_rows), np.int64)
        self._scratch = [pipeline.new_scratch() for _ in range(shares)]
        self._kernel = pipeline.plan.kernel.address(*self.arguments[0].measuring(0, 0, self._scratch[0]))

    def measure(
        self,
        share: int,
        frame: tuple[int, int],
        progress: Progress,
        waiting: tuple[NDArray[np.int64], NDArray[np.int64]],
        explain: bool,
        part: ProductPart = NO_PRODUCT,
        rehearse: Rehearsal | None = None,
    ) -> bool:
        """Measure one share of a frame (number, slot); return whether it was completed.

        `waiting` has the cell that ends waiting, and the share's `Arrival.pace`. See `FramePath.measure` for
        the others.
        """
        number, slot = frame
        work = (self._explaining if explain else self.arguments)[slot]
        start, last, stop = self._ranges[share]
        control, pace = waiting
        cells = progress.cells, progress.frame_cell, progress.rows_cell
        arrival = streaming.Arrival(*cells, control, STOP_CELL, pace, self._due)

        def stream(awaited: int, first: int, end: int) -> int:
            groups = work.measuring(first, end, self._scratch[share])
            done: int = self._stream(self._kernel, arrival, awaited, self._last_rows, *groups, part)
            return done

        pace[streaming.PENDING] = start
        if rehearse is not None:
            for group in sorted({start, last}):
                if stream(number, start, group) < group:
                    return False
                start = group
                if group == stop:
                    break
                rows = self._last_rows[group]
                self._multiply(arrival, number, rows, group, self._width, work.slopes, part)
                if self._sleep(arrival, number, rows, group):
                    # A frame that has passed is not waited for: only code and data come into the cache again.
                    stream(-1, last, last + 1)
                    rehearse()
                    pace[streaming.COLD] = 0
        done = stream(number, start, stop)
        self._multiply(arrival, number, self._frame_rows, done, self._width, work.slopes, part)
        return done == stop

    def _range(self, start: int, stop: int) -> tuple[int, int, int]:
        """Return a share's first group, the first that needs its last rows, and the one after the last."""
        return start, start + int(np.argmax(self._last_rows[start:stop])) if start < stop else stop, stop


class FramePath:
    """Measurement of frames while they arrive, with one state of the settings.

    Parameters
    ----------
    pipeline : SlopePipeline
    slots : sequence of (h, w) arrays
        Memory in which frames arrive: frame k in slot k % len(slots). uint16 or float32, contiguous.
    progress : Progress
    workers : Workers, optional
        Threads that measure together with the caller. Default: the caller's thread alone.
    prior : SlopePrior, optional
        Predicted slopes, which the caller changes between frames. Default: 0.

    Raises
    ------
    InputError
        When the slots do not fit the pipeline, or the settings need the frame's own flux, which is not known
        before its last row.
    """

    def __init__(
        self,
        pipeline: SlopePipeline,
        slots: Sequence[NDArray[np.generic]] | NDArray[np.generic],
        progress: Progress,
        *,
        workers: Workers | None = None,
        prior: SlopePrior | None = None,
    ) -> None:
        self.pipeline, self._progress, self._workers = pipeline, progress, workers
        self._check(slots)
        self._frames = [slot[None] for slot in slots]
        self._slot = 0  # of the last frame
        self._shares = 1 + (0 if workers is None else workers.count)
        self._no_product = [NO_PRODUCT] * self._shares
        n, pixels = len(pipeline.layout), pipeline.layout.pixels
        self._results = results = SlopeArrays(*(np.zeros((1, n), dtype) for dtype in RESULT_TYPES))
        self.slopes = Slopes(*(result[0] for result in results))
        """Slopes of the last frame; overwritten by the next one."""
        self._stages = np.zeros((STAGE_ROWS, 1, n, pixels), np.float32)
        self.fault: str | None = None
        """Reason why the estimator is disabled; always None for compiled ones, see `PythonPath`."""
        self.failed = False
        """Whether the estimator failed in the last frame."""
        self._control = np.zeros(1, np.int64)
        self._pace = np.zeros((self._shares, streaming.PACE_CELLS), np.int64)
        self._pace[:, streaming.MARGIN] = streaming.SHORTEST_NS
        self._start_due = np.zeros(1, np.int64)
        self._wait_for_group = Direct(streaming.wait_for_group)
        wide, rest = pipeline.width, n % pipeline.width
        full = n // wide
        # The remainder is measured in a narrower group if that is faster; it has the last rows.
        faster = rest > 0 and pipeline.plan.prepared.fewer_lanes_are_faster
        narrow = [width for width in WIDTHS if rest <= width < wide] if faster else []
        groups, after = (0, full if narrow else full + (rest > 0)), (results, self._stages)
        self._wide = _Groups(pipeline, slots, after, groups, self._shares, prior)
        self._checks = [pipeline.check(arguments) for arguments in self._wide.arguments]
        self._narrow = None
        if narrow:
            width = min(narrow)
            groups = full * wide // width, full * wide // width + 1
            self._narrow = _Groups(pipeline.with_width(width), slots, after, groups, 1, prior)
        self._prior, self._prior_changes = prior, 0
        self._dark_changes = 0
        self._usual_std_px = prior_std_px(pipeline.settings, pipeline.layout)
        self.prior_std_px = None if prior is None else self._usual_std_px
        """Standard deviation of the slopes' prior, (2 n,); None: no prior."""

    @property
    def denoised(self) -> NDArray[np.float32]:
        """Denoised images of the last frame that was measured with them, (n, ny, nx)."""
        images: NDArray[np.float32] = self._stages[DENOISED, 0]
        return images.reshape(-1, *self.pipeline.layout.window)

    @property
    def stopped(self) -> bool:
        """Whether `stop` has ended the wait for rows."""
        return bool(self._control[STOP_CELL])

    @property
    def woken_late(self) -> int:
        """Number of times that a thread has woken up after its rows were there."""
        return int(self._pace[:, streaming.WOKEN_LATE].sum())

    @property
    def sleeps(self) -> int:
        """Number of times that the caller's thread has slept until rows were due."""
        return int(self._pace[0, streaming.SLEEPS])

    def warm_up(self) -> None:
        """Measure the present content of the first slot, to compile everything and fill the caches."""
        progress = self._progress
        cells = np.zeros_like(progress.cells)  # of the same type, to avoid an extra compilation
        cells.flat[progress.frame_cell] = 1
        cell_progress = Progress(cells, progress.frame_cell, progress.rows_cell)
        if self._prior is not None:
            self._await_row(cell_progress, 0)
        for share in range(self._shares):
            self._work(share, (0, 0), cell_progress, explain=True, rehearse=lambda: None)
        self.flag_doubtful()

    def measure(
        self,
        number: int,
        slot: int | None = None,
        *,
        explain: bool = False,
        after_ns: int = 0,
        rehearse: Rehearsal | None = None,
        product: Sequence[ProductPart] = (),
    ) -> bool:
        """Measure a frame, waiting for its rows; return whether it was completed.

        It is not completed if `stop` was called meanwhile or a worker died.

        Parameters
        ----------
        number : int
            Frame number, as the progress counts.
        slot : int, optional
            Slot of the frame. Default: number % slots.
        explain : bool
            Whether to keep its denoised images.
        after_ns : int
            Time of the last row of the frame before (CLOCK_MONOTONIC), from which it is known when rows are
            due: the threads sleep until shortly before. Default: they poll.
        rehearse : function, optional
            Called after the last sleep, before the last rows are there. Other programs may have used the
            processor: it brings into the cache what the caller will use after the frame.
        product : sequence of ProductPart, optional
            A product with the slopes, a part for each thread, to be begun while the rows arrive.
        """
        for part in product:
            part.taken[:] = part.out[:] = 0.0
        self._pace[:, streaming.LAST_ROW] = after_ns
        if self._prior is not None and self._prior.changes != self._prior_changes:
            self._widen(self._prior)
        self._slot = number % len(self._frames) if slot is None else slot
        frame = number, self._slot
        parts = product or self._no_product
        if self._workers is None:
            return self._work(0, frame, self._progress, explain, parts[0], rehearse)
        self._workers.post(lambda share: self._work(share, frame, self._progress, explain, parts[share]))
        completed = self._work(0, frame, self._progress, explain, parts[0], rehearse)
        return self._workers.wait() and completed

    def locate(self) -> None:
        """Find the positions, after the slot is known to have held the frame; kernels have found them."""

    def flag_doubtful(self) -> None:
        """Set the flags of the last frame that depend on all its slopes; see `SlopePipeline`."""
        self._checks[self._slot]()

    @property
    def frame(self) -> NDArray[Any]:
        """Pixels of the last frame, (1, h, w), until others are written there."""
        return self._frames[self._slot]

    def set_dark(self, dark: NDArray[np.bool_], changes: int) -> None:
        """Set which sub-apertures have no flux: their slopes are 0. Return at once if nothing has changed.

        Parameters
        ----------
        dark : (n,) array of bool
        changes : int
            Number of its changes, from 0: none is dark.
        """
        if changes == self._dark_changes:
            return
        self._dark_changes = changes
        for groups in filter(None, (self._wide, self._narrow)):
            scale = groups.settings[ERROR_SCALE]
            np.copysign(scale, np.where(dark, -1.0, 1.0), out=scale)

    def await_start(self, number: int, after_ns: int = 0) -> None:
        """Wait for the first row of a frame, or until `stop` is called; `after_ns` as for `measure`."""
        self._pace[0, streaming.LAST_ROW] = after_ns
        self._await_row(self._progress, number)

    def stop(self) -> None:
        """End all waiting for rows, now and in future; callable from any thread."""
        self._control[STOP_CELL] = 1

    def go_on(self) -> None:
        """Allow waiting for rows again."""
        self._control[STOP_CELL] = 0

    def _await_row(self, progress: Progress, number: int) -> None:
        """Wait for the first row of a frame."""
        cells = progress.cells, progress.frame_cell, progress.rows_cell
        arrival = streaming.Arrival(*cells, self._control, STOP_CELL, self._pace[0], self._start_due)
        self._wait_for_group(arrival, number, 1, 0)

    def _work(
        self,
        share: int,
        frame: tuple[int, int],
        progress: Progress,
        explain: bool,
        part: ProductPart = NO_PRODUCT,
        rehearse: Rehearsal | None = None,
    ) -> bool:
        """Measure one share of a frame's groups; the last share includes the narrow group."""
        waiting = self._control, self._pace[share]
        narrow = self._narrow if share == self._shares - 1 else None
        completed = self._wide.measure(share, frame, progress, waiting, explain, part, rehearse)
        if narrow is None:
            return completed
        return completed and narrow.measure(0, frame, progress, waiting, explain, rehearse=rehearse)

    def _widen(self, prior: SlopePrior) -> None:
        """Set the width of the estimator's prior to the uncertainty of the prediction, where known."""
        self._prior_changes = prior.changes
        row = self.pipeline.plan.prepared.prior_weight_row
        if row is None:
            return
        usual = np.inf if self._usual_std_px is None else self._usual_std_px[: prior.std_px.size]
        std = np.where(np.isnan(prior.std_px), usual, prior.std_px)
        for groups in filter(None, (self._wide, self._narrow)):
            groups.settings[row] = std**-2.0
        self.prior_std_px = np.tile(std, 2) if np.isfinite(std).all() else None

    def _check(self, slots: Sequence[NDArray[np.generic]] | NDArray[np.generic]) -> None:
        """Refuse slots that the kernels cannot read, and settings that need the frame's own flux."""
        shape = self.pipeline.layout.frame_shape
        for slot in slots:
            readable = slot.dtype in (np.uint16, np.float32) and slot.flags.c_contiguous
            if slot.shape != shape or not readable:
                raise InputError(
                    f"stream: expected contiguous frames of {shape}, uint16 or float32, "
                    f"got {slot.shape} {slot.dtype}"
                )
        check_real_time(self.pipeline)


def check_real_time(pipeline: SlopePipeline) -> None:
    """Refuse settings that need the frame's own flux, which is not known before its last row."""
    if pipeline.needs_flux:
        raise InputError(
            "settings.flux_e: expected the flux (electrons) that a spot has in a frame, got none: in "
            f'real time {pipeline.settings.estimator.label} and "auto" need it before the frame is there'
        )


def last_rows_of_groups(pipeline: SlopePipeline, width: int) -> NDArray[np.int64]:
    """Return how many rows of the frame each group of `width` sub-apertures needs."""
    last = pipeline.layout.corners[:, 0] + pipeline.layout.window[0]
    groups = -(-len(last) // width)
    return np.array([last[g * width : (g + 1) * width].max() for g in range(groups)], np.int64)
