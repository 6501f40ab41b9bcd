"""Slopes predicted by another program and read from a pyshmem stream, as the prior of estimators."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from faintspot.engine.path.slope_prior import SlopePrior
from faintspot.engine.streams.stream import Follower

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
