"""The way of one frame through the engine: everything made beforehand, no memory taken while frames come.

A frame path belongs to one pipeline, that is to one state of the settings; when they change, the engine makes
another one beside the running system and takes it between two frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.kernels import located, streaming
from faintspot.kernels.host import lanes_for
from faintspot.kernels.parallel import new_scratch, new_spot_scratch
from faintspot.pipeline import RESULT_TYPES, SlopePipeline, Slopes

STOP_CELL = 0


@dataclass(frozen=True, eq=False)
class Progress:
    """Where a frame path looks how far a frame has arrived.

    Parameters
    ----------
    cells : int64 array
        In shared memory.
    frame_cell, rows_cell : int
        Where in it the number of the arriving frame, and its rows so far, are.
    """

    cells: NDArray[np.int64]
    frame_cell: int
    rows_cell: int


class FramePath:
    """Measures frames while they arrive, with one state of the settings.

    Parameters
    ----------
    pipeline : SlopePipeline
    slots : sequence of (h, w) arrays
        Where frames arrive: frame k in slot k % len(slots). uint16 or float32, contiguous.
    progress : Progress
    threads : int
        Workers, the caller's thread included.

    Raises
    ------
    InputError
        When the slots do not fit the pipeline, or settings follow the light of the frame itself, which is not
        known before its last row.
    """

    def __init__(
        self,
        pipeline: SlopePipeline,
        slots: Sequence[NDArray[Any]] | NDArray[Any],
        progress: Progress,
        *,
        threads: int = 1,
    ) -> None:
        self.pipeline, self._progress = pipeline, progress
        self._check(slots)
        lanes, layout = lanes_for(np.float32), pipeline.layout
        self._last_rows = last_rows_of_groups(pipeline, lanes.width)
        self._threads = max(1, min(threads, len(self._last_rows)))
        self._results = tuple(np.zeros((1, len(layout)), dtype) for dtype in RESULT_TYPES)
        self.slopes = Slopes(*(result[0] for result in self._results))
        """Of the frame measured last; overwritten by the next one."""
        self._control = np.zeros(1, np.int64)
        variants = np.zeros(1, np.int64)
        made = [pipeline.kernel_call(slot[None], slot.dtype, variants) for slot in slots]
        self._before = [arguments for _, arguments, _ in made]
        kernel, _, shape = made[0]
        gravity = kernel is not located.locate_groups
        self._kernel = streaming.stream_gravity if gravity else streaming.stream_located
        stages = np.empty((0, 1, len(layout), layout.pixels), np.float32)
        self._after = []
        for _ in range(self._threads):
            scratch = (
                new_scratch(lanes, *layout.window)
                if shape is None
                else new_spot_scratch(lanes, *layout.window, *shape)
            )
            self._after.append((scratch, self._results, stages))
        self._pool = ThreadPoolExecutor(self._threads - 1) if self._threads > 1 else None

    def warm_up(self) -> None:
        """Measure whatever the first slot holds, so that everything is compiled and in the caches."""
        progress = self._progress
        cells = np.zeros_like(progress.cells)  # of the same kind, so that nothing is compiled for it alone
        cells.flat[progress.frame_cell] = 1
        there = Progress(cells, progress.frame_cell, progress.rows_cell)
        for share in range(self._threads):
            self._work(share, 0, there)

    def measure(self, frame: int) -> bool:
        """Measure a frame, waiting for its rows; return whether it was measured to its end.

        Where not, `stop` was called meanwhile.
        """
        futures: list[Future[bool]] = []
        if self._pool is not None:
            shares = range(1, self._threads)
            futures = [self._pool.submit(self._work, share, frame, self._progress) for share in shares]
        whole = self._work(0, frame, self._progress)
        for future in futures:
            whole = future.result() and whole
        return whole

    def stop(self) -> None:
        """End all waiting for rows, now and in future; from any thread."""
        self._control[STOP_CELL] = 1

    def go_on(self) -> None:
        """Wait for rows again."""
        self._control[STOP_CELL] = 0

    def close(self) -> None:
        """End the workers."""
        self.stop()
        if self._pool is not None:
            self._pool.shutdown()

    def _work(self, share: int, frame: int, progress: Progress) -> bool:
        """Measure one share of a frame's groups."""
        groups = len(self._last_rows)
        start, stop = groups * share // self._threads, groups * (share + 1) // self._threads
        done: int = self._kernel(
            progress.cells,
            progress.frame_cell,
            progress.rows_cell,
            frame,
            self._last_rows,
            self._control,
            STOP_CELL,
            start,
            stop,
            self._before[frame % len(self._before)],
            self._after[share],
        )
        return done == stop

    def _check(self, slots: Sequence[NDArray[Any]] | NDArray[Any]) -> None:
        """Refuse slots that the kernels cannot read, and settings that are not known in time."""
        shape = self.pipeline.layout.frame_shape
        for slot in slots:
            readable = slot.dtype in (np.uint16, np.float32) and slot.flags.c_contiguous
            if slot.shape != shape or not readable:
                raise InputError(
                    f"stream: expected contiguous frames of {shape}, uint16 or float32, "
                    f"got {slot.shape} {slot.dtype}"
                )
        check_light_is_known(self.pipeline)


def check_light_is_known(pipeline: SlopePipeline) -> None:
    """Refuse settings that follow the light of a frame, which is not known before its last row."""
    if pipeline.needs_light:
        raise InputError(
            "settings.flux_e: expected the light (electrons) that a spot has in a frame, got none: in "
            'real time "map", "trained" and "auto" need it before the frame is there'
        )


def last_rows_of_groups(pipeline: SlopePipeline, width: int) -> NDArray[np.int64]:
    """Return how many rows of the frame each group of `width` sub-apertures needs."""
    last = pipeline.layout.corners[:, 0] + pipeline.layout.window[0]
    groups = -(-len(last) // width)
    return np.array([last[g * width : (g + 1) * width].max() for g in range(groups)], np.int64)
