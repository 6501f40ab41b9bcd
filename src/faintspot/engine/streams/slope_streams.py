"""Slopes and commands out, predictions in: pyshmem streams, for pyRTC and, by a bridge, ImageStreamIO."""

import contextlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from faintspot.base.errors import InputError
from faintspot.engine.frames.workers import SlopePrior
from faintspot.engine.streams.shared_streams import (
    LOCK_LIMIT_S,
    create_stream,
    generation,
    held,
    lock_file,
    pyshmem_module,
)
from faintspot.engine.streams.stream import Follower
from faintspot.slopes.kernels.compiling import Direct
from faintspot.slopes.kernels.products import fill_telemetry_rows
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes

DETAILS = (
    *("flux_e", "valid", "standard_error_x_px", "standard_error_y_px", "iterations", "flags"),
    "covariance_xy_px2",
)
"""Rows of the stream of details."""
MARKS = ("frame", "method", "settings_change", "last_row_ns", "published_ns")
"""Contents of the stream of marks; times are those of CLOCK_MONOTONIC."""


class SlopeStreams:
    """Three streams, or four with commands, each stamped with the frame's number as `frame_id`.

    NAME_slopes holds all x, then all y, float32 px (2 n,), for a reconstructor. NAME_details holds (7, n)
    float32, rows as `DETAILS`. NAME_marks holds int64 numbers and times of the measurement, as `MARKS`. The
    slopes are published first. NAME_commands holds the mirror's commands, float32 (commands,), in the
    interaction matrix's unit.

    Parameters
    ----------
    name : str
    n : int
        Number of sub-apertures.
    commands : int
        Number of commands; 0: no stream of commands.

    Attributes
    ----------
    held_commands : (commands,) array or None
        Last commands of an engine of that name that has died.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    InputError
        When a living process publishes under that name, another user has taken it, or shared memory is short.
    """

    def __init__(self, name: str, n: int, commands: int = 0) -> None:
        stream = f"{name}_commands"
        self.held_commands = commands_left_behind(stream, commands) if commands else None
        with ExitStack() as undo:

            def made(what: str, *shape: int, dtype: DTypeLike = np.float32) -> Any:
                new = create_stream(f"{name}_{what}", shape, dtype)
                undo.callback(new.unlink)
                return new

            self._slopes, self._rehearsal = made("slopes", 2 * n), made("rehearsal", 2 * n)
            self._details = made("details", len(DETAILS), n)
            self._marks = made("marks", len(MARKS), dtype=np.int64)
            self._commands = made("commands", commands) if commands else None
            undo.pop_all()
        self._of_commands = stream, (commands,)
        self._generation = generation(stream)
        self._commands_lock = ExitStack()
        self.commands_lost = False
        """Whether the stream of commands must be recreated."""
        self._n, self._closed = n, False
        self._fill = Direct(fill_telemetry_rows)
        self._counts = np.zeros(3, np.int64)
        self._fill_details(
            Slopes(*(np.zeros(n, kind) for kind in RESULT_TYPES)), np.zeros((len(DETAILS), n), np.float32)
        )

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the streams' locks while publishing; see `shared_streams.held`."""
        with held(self._slopes, self._rehearsal, self._details, self._marks), self._commands_lock:
            if self._commands is not None:
                self._commands_lock.enter_context(held(self._commands))
            yield

    def publish_slopes(self, slopes: Slopes, frame: int) -> None:
        """Publish the vector of slopes; for the thread that holds the streams."""
        self._write_slopes(self._slopes, slopes, frame)

    def rehearse(self, slopes: Slopes, frame: int) -> None:
        """Write slopes where nobody reads them, so that code and data are in the processor's cache."""
        self._write_slopes(self._rehearsal, slopes, frame)

    def _write_slopes(self, stream: Any, slopes: Slopes, frame: int) -> None:
        with stream.write_view_locked(frame_id=frame) as vector:
            vector[: self._n] = slopes.x
            vector[self._n :] = slopes.y

    def publish_commands(self, commands: NDArray[np.float64], frame: int) -> None:
        """Publish the commands that follow from a frame; for the thread that holds the streams."""
        if self._commands is None:  # it was lost
            return
        with self._commands.write_view_locked(frame_id=frame) as vector:
            vector[:] = commands

    def renew_commands(self) -> bool:
        """Recreate the stream of commands after it was removed; for the thread that holds the streams.

        Returns
        -------
        bool
            False if another program publishes under its name.
        """
        self.commands_lost = False
        if self._commands is not None:
            self._commands_lock.close()
            self._commands.close()
            self._commands = None
        try:
            new = create_stream(*self._of_commands, patience_s=0.0)
            self._commands_lock.enter_context(held(new))
        except InputError:
            return False
        self._commands, self._generation = new, generation(new.name)
        return True

    def look_after_commands(self) -> None:
        """Request that the stream of commands be recreated if it was removed; for any thread."""
        if self._of_commands[1][0] and generation(self._of_commands[0]) != self._generation:
            self.commands_lost = True

    def publish_details(self, slopes: Slopes, frame: int) -> tuple[int, int, int]:
        """Publish the details of each slope; for the thread that holds the streams.

        Returns
        -------
        invalid, limited, iterations : int
            Numbers of sub-apertures without a slope and of those whose denoising ended at the iteration
            limit, and the total number of iterations.
        """
        with self._details.write_view_locked(frame_id=frame) as table:
            self._fill_details(slopes, table)
        invalid, limited, iterations = self._counts.tolist()
        return invalid, limited, iterations

    def _fill_details(self, slopes: Slopes, table: NDArray[np.float32]) -> None:
        """Write the rows of `DETAILS` and count invalid slopes and iterations."""
        errors = slopes.standard_error_x, slopes.standard_error_y, slopes.covariance_xy
        self._fill(slopes.flux, slopes.flags, slopes.iterations, *errors, self._counts, table)

    def publish_marks(self, marks: tuple[int, ...]) -> None:
        """Publish the numbers and times of a frame; for the thread that holds the streams."""
        with self._marks.write_view_locked(frame_id=marks[0]) as row:
            row[:] = marks

    def commands_obstacle(self) -> str | None:
        """Return why the commands cannot be read by other programs, or None; for any thread."""
        name, (commands,) = self._of_commands
        present = generation(name)
        if not commands or self._closed or (self._commands is not None and present == self._generation):
            return None
        if present is None:
            return f"{name} was removed"
        return f"{name} was recreated by another program; end that program"

    def close(self) -> None:
        """Remove all streams."""
        self._closed = True
        for stream in (self._slopes, self._rehearsal, self._details, self._marks, self._commands):
            if stream is not None:
                stream.unlink()


def commands_left_behind(stream: str, commands: int) -> NDArray[np.float32] | None:
    """Return the last commands of a stream whose writer has died; None if there are none that fit.

    If it died while writing, some commands are those of the frame before, which is harmless to a mirror.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    InputError
        When the lock folder is not private.
    """
    pyshmem = pyshmem_module("publishing commands in shared memory")
    lock_file(stream)
    try:
        stream_left = pyshmem.open(stream, gpu_device=False)
    except (OSError, ValueError):  # missing or damaged
        return None
    try:
        if not stream_left.count or tuple(stream_left.shape) != (commands,) or stream_left.dtype.kind != "f":
            return None
        with stream_left.locked(timeout=LOCK_LIMIT_S):
            values = np.array(stream_left.read(safe=False), np.float32)
    except (TimeoutError, RuntimeError):  # a living process holds it
        return None
    finally:
        stream_left.close()
    return values if np.isfinite(values).all() else None


_READ_S = 2e-4  # to wait for a writer in the middle of a publication


@dataclass(slots=True)
class PredictionCounters:
    """Counters of received predictions, changed in place."""

    taken: int = 0
    """Frames that were measured with their prediction."""
    late: int = 0
    """Frames whose prediction had not come when their first row arrived; their prior was 0."""
    refused: int = 0
    """Predictions whose mean was not finite or too large; the prior was 0."""
    restarts: int = 0
    """Number of times that the stream was removed or recreated."""


class PredictionStream:
    """The stream NAME_prediction of floats: 2 n slopes [px], their 2 n variances, the frame number.

    Slopes are all x, then all y, as the engine publishes them. A variance that is not a positive number means
    unknown: the estimator's prior then has the width from its settings (`prior_std_px`).

    Parameters
    ----------
    name : str
        Name of the engine.
    prior : SlopePrior
        Prior that receives the predictions.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, name: str, prior: SlopePrior) -> None:
        self.stream, self._prior = f"{name}_prediction", prior
        self._values = np.zeros(2 * prior.mean_px.size + 1)
        self.counters = PredictionCounters()
        self._follower = Follower(self.stream, incompatible=self._incompatible)
        self.look_after()

    def fill(self, number: int) -> None:
        """Set the prior to the prediction for a frame, or to none; for the engine's thread."""
        self._prior.forget()
        counters, values = self.counters, self._values
        if not self._read() or values[-1] != number:
            counters.late += 1
            return
        mean, variance = values[:-1].reshape(2, -1)
        if not np.abs(mean).max() <= self._prior.largest_px:
            counters.refused += 1
            return
        counters.taken += 1
        self._prior.expect(mean, np.sqrt(np.maximum(variance, 0.0)))

    def _read(self) -> bool:
        """Read the newest prediction; return whether there is one, and the stream is not being closed."""
        using = self._follower.using
        if not using.acquire(blocking=False):
            return False
        try:
            source = self._follower.source
            return bool(
                source is not None and source.count and source.read(self._values, _READ_S) is not None
            )
        except Exception:  # nothing raises in the frame path
            return False
        finally:
            using.release()

    def look_after(self) -> None:
        """Check whether the stream is the same, and try to open a missing one; for any other thread."""
        self._follower.look()
        self.counters.restarts = self._follower.counters.restarts

    def status(self) -> dict[str, Any]:
        """Return the stream's state as plain values."""
        return {"stream": self.stream, "obstacle": self._follower.obstacle, **asdict(self.counters)}

    def close(self) -> None:
        """Close the stream."""
        with contextlib.suppress(Exception):
            self._follower.close()

    def _incompatible(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
        """Return what was expected, or "" if these can be predictions."""
        return "" if shape == self._values.shape and dtype.kind == "f" else f"{self._values.shape} floats"
