"""A Kalman filter of open-loop slopes, which predicts the next frame's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.control.models import SlopeModel

Floats = NDArray[np.float64]

_MOST_DOUBLINGS = 40
_CONVERGED = 1e-9
LARGEST_VARIANCE_PX2 = 1e6
"""Of a slope that was not measured."""


class SlopePredictor:
    """The Kalman filter of a `SlopeModel`: state [z[k], z[k - 1]], of which noisy z[k] is measured.

    The error of its predictions is the steady one, for slopes with their usual noise; how much each slope
    corrects follows the noise of each frame.

    Parameters
    ----------
    model : SlopeModel
    variance_px2 : (m,) array
        Usual variance of the slopes' noise.
    steady : bool
        Whether the gain does not follow the noise of frames: one product with a matrix, much less work.
    """

    def __init__(self, model: SlopeModel, variance_px2: Floats, *, steady: bool = False) -> None:
        self.model, self._steady = model, steady
        m = model.slopes
        self.covariance = steady_covariance(model, variance_px2)
        """(2 m, 2 m): of the state's error before a frame is measured."""
        self.usual_px2 = self.covariance[:m, :m] + np.diag(np.minimum(variance_px2, LARGEST_VARIANCE_PX2))
        """(m, m): covariance of measured slopes about the prediction, with their usual noise."""
        self._gain = np.linalg.solve(self.usual_px2, self.covariance[:m]).T
        self._onward = model.both
        self.state = np.zeros(2 * m)
        self._correction = np.zeros(2 * m)

    @property
    def mean_px(self) -> Floats:
        """(m,): what the coming frame's open-loop slopes are expected to be."""
        return self.state[: self.model.slopes]

    @property
    def std_px(self) -> Floats:
        """(m,): how far they will be from that."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[: self.model.slopes]))

    def correct(self, slopes_px: Floats, variance_px2: Floats) -> None:
        """Take the measured open-loop slopes of this frame; infinite variance: not measured."""
        m = self.model.slopes
        surprise = slopes_px - self.state[:m]
        if self._steady:
            surprise[~np.isfinite(variance_px2)] = 0.0
            np.matmul(self._gain, surprise, out=self._correction)
        else:
            variance = np.minimum(variance_px2, LARGEST_VARIANCE_PX2)
            surprise[variance >= LARGEST_VARIANCE_PX2] = 0.0
            total = self.covariance[:m, :m].copy()
            total[np.diag_indices(m)] += variance
            np.matmul(self.covariance[:, :m], np.linalg.solve(total, surprise), out=self._correction)
        self.state += self._correction

    def advance(self) -> None:
        """Go on to the next frame."""
        m = self.model.slopes
        now = self._onward @ self.state
        self.state[m:] = self.state[:m]
        self.state[:m] = now


def steady_covariance(model: SlopeModel, variance_px2: Floats) -> Floats:
    """Return the covariance (2 m, 2 m) of the predicted state's error that a Kalman filter comes to.

    The discrete algebraic Riccati equation by doubling (Chu, Fan & Lin 2005, Linear Algebra Appl. 396, 55):
    twice as many frames with each step.
    """
    m = model.slopes
    step = np.zeros((2 * m, 2 * m))
    step[:, :m] = np.vstack([model.first.T, model.second.T])  # transposed: of the dual problem
    step[:m, m:] = np.eye(m)
    informed, error = np.zeros_like(step), np.zeros_like(step)
    informed[:m, :m] = np.diag(1 / np.minimum(variance_px2, LARGEST_VARIANCE_PX2))
    error[:m, :m] = model.driving
    identity = np.eye(2 * m)
    for _ in range(_MOST_DOUBLINGS):
        solved = np.linalg.solve(identity + informed @ error, np.hstack([step, informed]))
        more = step.T @ error @ solved[:, : 2 * m]
        informed = informed + step @ solved[:, 2 * m :] @ step.T
        step = step @ solved[:, : 2 * m]
        error = error + 0.5 * (more + more.T)
        if np.abs(more).max() <= _CONVERGED * np.abs(error).max():
            break
    return np.asarray(error)
