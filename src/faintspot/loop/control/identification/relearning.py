"""Frames that a controller keeps of its own loop, and the process that learns from them beside it."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.reconstructor import make_reconstructor

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

FRAMES = 2000
"""Frames that are kept, of large sensors fewer."""
_MOST_BYTES = 64 << 20
_LOWER_PRIORITY = 10  # above that of this process

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
    """Work of another process of lower priority, for which a thread waits.

    Parameters
    ----------
    code : str
        Python code of the process; its argument is a folder.
    write : callable
        Write the process's input to the folder.
    read : callable
        Read what the process has written.
    """

    def __init__(self, code: str, write: Callable[[Path], None], read: Callable[[Path], Result]) -> None:
        self._work, self._result = (code, write, read), list[Result]()
        self._child: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):  # then there is no result
            self._work_in_process()

    def _work_in_process(self) -> None:
        code, write, read = self._work
        with tempfile.TemporaryDirectory(prefix="faintspot-learning-") as name:
            folder = Path(name)
            write(folder)
            self._child = subprocess.Popen(
                [sys.executable, "-c", code, name],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
            end = weakref.finalize(self, self._child.kill)
            with contextlib.suppress(OSError, AttributeError):  # the process has ended, or Windows
                priority = min(os.getpriority(os.PRIO_PROCESS, 0) + _LOWER_PRIORITY, 19)
                os.setpriority(os.PRIO_PROCESS, self._child.pid, priority)
            self._child.wait()
            end.detach()
            self._result.append(read(folder))

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._thread.is_alive()

    def result(self) -> Result | None:
        """Wait for the end, and return what was read; None if the work failed."""
        self._thread.join()
        return self._result[0] if self._result else None


_STORED = (
    "interaction_matrix",
    "cells",
    "frame_rate_hz",
    "subaperture_m",
    "pixel_scale_arcsec",
    "outer_scale_m",
)
STORED = tuple(f"recorded_{name}" for name in _STORED)
"""Names in files of what is known of the recorded loop."""


def stored(loop: Recording) -> dict[str, NDArray[Any]]:
    """Return what is known of a recorded loop as arrays by name."""
    values = {f"recorded_{name}": getattr(loop, name) for name in _STORED}
    return {name: np.asarray(value) for name, value in values.items() if value is not None}


def restored(arrays: Mapping[str, NDArray[Any]]) -> Recording | None:
    """Return a recorded loop, of one frame of zeros, from arrays by name; None if there are none.

    Raises
    ------
    InputError
        When they do not fit together.
    """
    known: dict[str, Any] = {name: arrays.get(f"recorded_{name}") for name in _STORED}
    matrix = known.pop("interaction_matrix")
    if matrix is None:
        return None
    known = {
        name: value.item() if np.ndim(value) == 0 and value is not None else value
        for name, value in known.items()
    }
    slopes, commands = np.atleast_2d(matrix).shape
    return Recording(np.zeros((1, slopes)), np.zeros((1, commands)), matrix, **known)


def replayed_slopes(
    control: Callable[[Floats], Floats],
    open_loop: OpenLoopTelemetry,
    matrix: Floats,
    scale: Floats,
    delay: int,
) -> Floats:
    """Return the mean square of the residual slopes that commands control, frame by frame, (frames,).

    Parameters
    ----------
    control : callable
        Command of a frame of slopes.
    open_loop : OpenLoopTelemetry
        Slopes without the mirror, with the noise of the recording.
    matrix : (m, commands) array
        Slopes of a unit of each command.
    scale : (m,) array
        Such slopes in a unit of the controller's.
    delay : int
        Frames.
    """
    sent = deque([np.zeros(matrix.shape[1])] * delay)
    squares, controlled = [], matrix @ make_reconstructor(matrix).clean
    for slopes, variance in zip(open_loop.open_loop_px, open_loop.variance_px2, strict=True):
        residual = slopes + matrix @ sent.popleft()
        sent.append(control(np.where(np.isfinite(variance), residual, np.nan) / scale))
        squares.append(float(np.square(controlled @ residual).mean()))
    return np.array(squares)
