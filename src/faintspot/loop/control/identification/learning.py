"""Controllers that learn from telemetry, and again from frames of their own loop, in a process beside it."""

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
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.base import ASSUMED, LEARNT, SETTLE_FRAMES, OpenLoopTelemetry
from faintspot.loop.control.flattening import phase_of_commands
from faintspot.loop.control.identification.layers import AVERAGED, Identification, Identified
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import SlopeTurbulence

GAINS = (0.03, 0.05, 0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.36, 0.43, 0.5, 0.6, 0.7, 0.8)
"""Gains of an integrator that are tried."""
_MOST_REPLAYED, _FEWEST_REPLAYED = 1_200_000, 500  # slopes, and frames, by which controllers are compared

JUDGED_PART = 0.35
"""Part of a stretch, its end, on which models are judged; they are learnt from the rest."""
STANDARD_ERRORS = 2.0
_BLOCK_FRAMES = 25
_FEWEST_BLOCKS = 10
FEWEST_FRAMES = math.ceil(_FEWEST_BLOCKS * _BLOCK_FRAMES / JUDGED_PART) + 1
"""Frames of a stretch that can be learnt from and judged on."""

Singles = NDArray[np.float32]

FRAMES = 2000
"""Frames that are kept, of large sensors fewer."""
_MOST_BYTES = 64 << 20
_LOWER_PRIORITY = 10  # above that of this process
_CALL = (
    "import pickle, sys; result, sys.stdout = sys.stdout.buffer, sys.stderr; "
    "function, arguments = pickle.load(sys.stdin.buffer); pickle.dump(function(*arguments), result)"
)

Result = TypeVar("Result")


def learn_controller(
    plant: LoopPlant,
    telemetry: OpenLoopTelemetry,
    site: SlopeTurbulence,
    rate_hz: float,
    winds: str = LEARNT,
    start: Identified | None = None,
    progress: Callable[[int, int], None] | None = None,
    identification: Identification | None = None,
) -> Kalman:
    """Return a Kalman filter learnt from telemetry.

    Parameters
    ----------
    plant : Plant
    telemetry : OpenLoopTelemetry
    site : SlopeTurbulence
        Geometry of the sensor, outer scale and, for winds that are assumed, these.
    rate_hz : float
        Frames per second.
    winds : str
        One of `WINDS`.
    start : Identified, optional
        Earlier turbulence of the same site, from which winds are learnt faster.
    progress : callable, optional
        Called with the steps done and their number while filters of many slopes are computed.
    identification : Identification, optional
        Of this telemetry, with fits that were made before.
    """
    cells = np.rint(site.positions_m[:, ::-1] / site.subaperture_m).astype(np.int64)
    of_commands = phase_of_commands(plant.interaction, cells)
    part = replayed_part(telemetry, len(plant.interaction))
    gain, plain_residual = plant.best_gain(GAINS, part, of_commands @ plant.reconstructor.matrix)
    model = Kalman({}, gain, 1.0, (math.inf, plain_residual), of_commands)
    known = Identification(telemetry, site, rate_hz) if identification is None else identification
    return model.best_of(plant, part, _fits(known.among(AVERAGED[:1]), site, winds, start), progress)


def replayed_part(telemetry: OpenLoopTelemetry, slopes: int) -> OpenLoopTelemetry:
    """Return the frames by which controllers are compared."""
    return telemetry.part(-max(_FEWEST_REPLAYED, _MOST_REPLAYED // slopes), None)


def _fits(
    identification: Identification, site: SlopeTurbulence, winds: str, start: Identified | None
) -> list[Identified]:
    """Return the turbulence with the winds, and from anywhere where that is not ruled out by `start`."""
    earlier = start if start is not None and start.is_layered and winds == LEARNT else None
    if earlier is not None:  # the comparison was made before
        return [identification.layers(earlier)]
    anywhere = identification.anywhere()
    if winds == LEARNT:
        windy = identification.layers(None)
    elif winds == ASSUMED:
        windy = identification.of_winds(site.wind_m_per_s)
    else:
        return [anywhere]
    # A line that the winds explain is no vibration in either model.
    return [windy, replace(anywhere, vibrations=windy.vibrations)]


@dataclass(frozen=True, eq=False)
class RelearntControl:
    """New filter, and the residual phase variance that it and others would have left on the same frames.

    All are computed for the centroid gain that was found.
    """

    learnt: Kalman
    residual: float
    by_running: float
    by_integrator: float
    error: float
    """Standard error of `by_running` minus `residual`."""
    delay: LoopDelay | None = None
    """Centroid gain that was found, relative to that of the slopes; None: it was not measured."""
    gain_changed: bool = False
    """Whether it differs from the running filter's beyond its error."""

    @property
    def is_better(self) -> bool:
        """Whether the new filter leaves less than the integrator, and than the running one beyond the error.

        A running filter with another centroid gain would leave more than computed: it is always replaced.
        """
        saved = self.by_running - self.residual
        return (self.gain_changed or saved > STANDARD_ERRORS * self.error) and (
            self.residual < self.by_integrator
        )

    def summary(self) -> str:
        """Return a summary of one line."""
        part, error = self.residual / self.by_running, self.error / self.by_running
        of_integrator = self.residual / self.by_integrator
        gain = "" if self.delay is None else f"{self.delay.gain_summary}, "
        return (
            f"{gain}{self.learnt.description}; phase variance {part:.3f} +- {error:.3f} of the running "
            f"filter's, {of_integrator:.2f} of the integrator's"
        )


def relearn(
    plant: LoopPlant,
    running: Kalman,
    telemetry: OpenLoopTelemetry,
    site: SlopeTurbulence,
    rate_hz: float,
    start: Identified | None = None,
    delay: LoopDelay | None = None,
) -> RelearntControl:
    """Learn from the first part of telemetry, and judge on the rest by replay; nothing else is changed.

    All filters are replayed on the same open-loop slopes, each with its own commands, so that nothing is
    risked on the mirror. The running filter must not have learnt from this telemetry.

    Parameters
    ----------
    plant : Plant
    running : Model
        Model of the Kalman filter in use.
    telemetry : OpenLoopTelemetry
        Consecutive frames.
    site : SlopeTurbulence
    rate_hz : float
        Frames per second.
    start : Identified, optional
        Turbulence that was found before, from which the search starts: faster, but finds no new layer.
    delay : LoopDelay, optional
        With the centroid gain of the telemetry. Default: that of the running filter, not measured again.

    Raises
    ------
    InputError
        When there are too few frames.
    """
    frames = len(telemetry)
    if frames < FEWEST_FRAMES:
        raise InputError(f"telemetry: expected {FEWEST_FRAMES} frames to judge a filter, got {frames}")
    first = frames - round(JUDGED_PART * frames)
    new = learn_controller(plant, telemetry.part(0, first), site, rate_hz, start=start)
    identified, begin = new.identified, max(0, first - SETTLE_FRAMES)
    replayed = telemetry.part(begin, None)  # all have settled when the part begins that they are judged on
    phase = new.phase(plant)
    by_integrator = plant.replayed_integrators([new.plain_gain], replayed, phase)[0]
    residuals = *(model.replayed(plant, replayed, phase) for model in (new, running)), by_integrator
    by_new, by_running, by_integrator = (squares[first - begin :] for squares in residuals)
    gain = running.centroid_gain if delay is None else delay.gain
    changed = delay is not None and abs(gain - running.centroid_gain) > STANDARD_ERRORS * delay.gain_error
    if changed and by_running.mean() < by_new.mean():  # the turbulence known before fits better
        new, by_new = replace(running, plain_gain=new.plain_gain), by_running
    means = float(by_new.mean()), float(by_running.mean()), float(by_integrator.mean())
    # By the residuals the engine chooses what begins.
    learnt = replace(new, left=(means[0], means[2]), centroid_gain=gain, identified=identified)
    error = error_of_mean(by_running - by_new)
    return RelearntControl(learnt, *means, error, delay, changed)


def error_of_mean(values: Floats) -> float:
    """Return the standard error of the mean of correlated values, from the scatter of blocks."""
    blocks = len(values) // _BLOCK_FRAMES
    means = values[: blocks * _BLOCK_FRAMES].reshape(blocks, _BLOCK_FRAMES).mean(axis=1)
    with np.errstate(invalid="ignore"):
        error = float(means.std(ddof=1)) / math.sqrt(blocks)
    return error if math.isfinite(error) else math.inf


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
