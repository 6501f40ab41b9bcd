"""Learning in a process beside the loop: recent frames, the process, and what judges the filter that came."""

import contextlib
import math
import os
import pickle
import subprocess
import sys
import threading
import weakref
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.reconstructor import make_reconstructor

Singles = NDArray[np.float32]

FRAMES = 2000
"""Frames that are kept, of large sensors fewer."""
_MOST_BYTES = 64 << 20
_LOWER_PRIORITY = 10  # above that of this process
_CALL = (
    "import pickle, sys; result, sys.stdout = sys.stdout.buffer, sys.stderr; "
    "function, arguments = pickle.load(sys.stdin.buffer); pickle.dump(function(*arguments), result)"
)

STANDARD_ERRORS = 2.0
"""By which a filter must be better to replace another one."""
BLOCK_FRAMES = 25

Result = TypeVar("Result")


class RecentFrames:
    """Latest slopes and commands of a running loop, in bounded memory.

    Parameters
    ----------
    slopes, commands : int
        Numbers of a frame.
    """

    def __init__(self, slopes: int, commands: int) -> None:
        frames = max(1, min(FRAMES, _MOST_BYTES // (4 * (slopes + commands))))
        self._slopes = np.zeros((frames, slopes), np.float32)
        self._commands = np.zeros((frames, commands), np.float32)
        self._next = self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, slopes: Floats, command: Floats) -> None:
        """Add a frame; NaN where a slope was not measured in it."""
        self._slopes[self._next], self._commands[self._next] = slopes, command
        self._next = (self._next + 1) % len(self._slopes)
        self._count = min(self._count + 1, len(self._slopes))

    def clear(self) -> None:
        """Forget all frames."""
        self._next = self._count = 0

    def latest(self, frames: int) -> tuple[Singles, Singles]:
        """Return slopes (k, m) and commands (k, c) of the latest frames, k of them at most."""
        rows = (self._next - np.arange(min(frames, self._count), 0, -1)) % len(self._slopes)
        return self._slopes[rows], self._commands[rows]


class BesideTheLoop(Generic[Result]):
    """Call of a function by another process of lower priority, for which a thread waits.

    Parameters
    ----------
    function : callable
    *arguments
        Its arguments. These, the function and its result can be pickled.
    """

    def __init__(self, function: Callable[..., Result], *arguments: object) -> None:
        self._call, self._result = (function, arguments), list[Result]()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with contextlib.suppress(Exception):  # a damaged answer may raise anything: then there is no result
            self._call_in_process()

    def _call_in_process(self) -> None:
        child = subprocess.Popen(
            [sys.executable, "-c", _CALL],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )
        end = weakref.finalize(self, child.kill)
        with contextlib.suppress(OSError, AttributeError):  # the process has ended, or Windows
            priority = min(os.getpriority(os.PRIO_PROCESS, 0) + _LOWER_PRIORITY, 19)
            os.setpriority(os.PRIO_PROCESS, child.pid, priority)
        answer, _ = child.communicate(pickle.dumps(self._call))
        end.detach()
        self._result.append(pickle.loads(answer))

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._thread.is_alive()

    def result(self) -> Result | None:
        """Wait for the end, and return the function's result; None if it failed."""
        self._thread.join()
        return self._result[0] if self._result else None


def replayed_slopes(
    control: Callable[[Floats], Floats], open_loop: OpenLoopTelemetry, matrix: Floats, delay: int
) -> Floats:
    """Return the mean square of the residual slopes that commands control, frame by frame, (frames,).

    Parameters
    ----------
    control : callable
        Command of a frame of slopes, which are NaN where not measured.
    open_loop : OpenLoopTelemetry
        Slopes without the mirror, with the noise of the recording.
    matrix : (m, commands) array
        Slopes of a unit of each command.
    delay : int
        Frames.
    """
    sent = deque([np.zeros(matrix.shape[1])] * delay)
    squares, controlled = [], matrix @ make_reconstructor(matrix).clean
    for slopes, variance in zip(open_loop.open_loop_px, open_loop.variance_px2, strict=True):
        residual = slopes + matrix @ sent.popleft()
        sent.append(control(np.where(np.isfinite(variance), residual, np.nan)))
        squares.append(float(np.square(controlled @ residual).mean()))
    return np.array(squares)


def error_of_mean(values: Floats) -> float:
    """Return the standard error of the mean of correlated values, from the scatter of blocks."""
    blocks = len(values) // BLOCK_FRAMES
    means = values[: blocks * BLOCK_FRAMES].reshape(blocks, BLOCK_FRAMES).mean(axis=1)
    with np.errstate(invalid="ignore"):
        error = float(means.std(ddof=1)) / math.sqrt(blocks)
    return error if math.isfinite(error) else math.inf
