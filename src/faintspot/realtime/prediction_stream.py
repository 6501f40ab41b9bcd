"""Slopes predicted by another program and read from a pyshmem stream, as the prior of estimators."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from faintspot.realtime.prior import Prior
from faintspot.realtime.shared_streams import lock_file, pyshmem_module

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
    prior : Prior
        Prior that receives the predictions.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, name: str, prior: Prior) -> None:
        self._pyshmem: Any = pyshmem_module("reading predictions in shared memory")
        self.stream, self._prior = f"{name}_prediction", prior
        self._slopes = prior.mean_px.size
        self._length = 2 * self._slopes + 1
        self._source: Any = None
        self.counters, self.obstacle = PredictionCounters(), "is not there"
        self.look_after()

    def fill(self, number: int) -> None:
        """Set the prior to the prediction for a frame, or to none; for the engine's thread."""
        self._prior.forget()
        source, counters = self._source, self.counters
        if source is None or not source.count:
            counters.late += 1
            return
        try:
            values = source.read(timeout=_READ_S)
        except Exception:  # the writer died, or the stream was closed meanwhile
            counters.late += 1
            return
        if values[-1] != number:
            counters.late += 1
            return
        mean, variance = values[:-1].astype(np.float64).reshape(2, -1)
        if not np.abs(mean).max() <= self._prior.largest_px:
            counters.refused += 1
            return
        counters.taken += 1
        self._prior.expect(mean, np.sqrt(np.maximum(variance, 0.0)))

    def look_after(self) -> None:
        """Check whether the stream is the same, and try to open a missing one; for any other thread."""
        source = self._source
        try:
            there = self._pyshmem.stat(self.stream)["instance_id"]
        except (OSError, ValueError):
            there = None
        if source is not None:
            if there == source.instance_id:
                return
            self.counters.restarts += 1
            self.close()
        if there is None:
            self.obstacle = "is not there"
        else:
            self._open()

    def status(self) -> dict[str, Any]:
        """Return the stream's state as plain values."""
        return {"stream": self.stream, "obstacle": self.obstacle, **asdict(self.counters)}

    def close(self) -> None:
        """Close the stream."""
        source, self._source = self._source, None
        if source is not None:
            with contextlib.suppress(Exception):
                source.close()

    def _open(self) -> None:
        lock_file(self.stream)  # refuse a folder that is not private
        try:
            source = self._pyshmem.open(self.stream, gpu_device=False)
        except (OSError, ValueError) as error:
            self.obstacle = f"cannot be opened ({' '.join(str(error).split())})"
            return
        if tuple(source.shape) != (self._length,) or source.dtype.kind != "f":
            self.obstacle = f"holds {tuple(source.shape)} {source.dtype}, expected ({self._length},) floats"
            source.close()
            return
        self._source, self.obstacle = source, ""
