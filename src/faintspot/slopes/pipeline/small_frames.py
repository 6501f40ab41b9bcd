"""Single frames of small sensors, for which preparing the kernel's arguments takes longer than the kernel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.kernels.driver.groups import Scratch, SlopeArrays, Source
from faintspot.slopes.pipeline.plan import Plan
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes

NO_STAGES = np.empty((0, 0, 0, 0), np.float32)


class SmallFrames:
    """Measurement of frames of one type, one at a time, in one thread; all memory is allocated once.

    Parameters
    ----------
    plan : Plan
        Of an estimator with a kernel, whose settings do not depend on the flux of each frame.
    source : Source
        A frame (1, h, w), into which each frame is copied, and its calibration.
    scratch : Scratch
        Memory of the thread.
    flag_doubtful : function
        Sets the flags that depend on all slopes, see `SlopePipeline.flag_doubtful`.
    """

    def __init__(
        self,
        plan: Plan,
        source: Source,
        scratch: Scratch,
        flag_doubtful: Callable[[SlopeArrays, NDArray[np.generic]], None],
    ) -> None:
        n = len(source.corners)
        groups = -(-n // source.lanes.width)
        self._frame = source.frames[0]
        self._results = SlopeArrays(*(np.empty((1, n), kind) for kind in RESULT_TYPES))
        self._slopes = [result[0] for result in self._results]
        self._kernel = plan.kernel(source.frames)
        task = plan.task(np.zeros(1, np.int64))
        self._arguments = source, task, 0, groups, scratch, self._results, NO_STAGES
        self._flag_doubtful = flag_doubtful

    def __call__(self, frame: NDArray[np.generic]) -> Slopes:
        """Measure a frame (h, w)."""
        np.copyto(self._frame, frame)
        self._kernel(*self._arguments)
        self._flag_doubtful(self._results, self._frame[None])
        return Slopes(*[values.copy() for values in self._slopes])
