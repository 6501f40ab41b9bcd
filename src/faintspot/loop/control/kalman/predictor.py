"""Kalman filter that predicts open-loop slopes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.kalman.slope_model import SlopeModel
from faintspot.loop.control.noise import add_noise, weighted_slopes

Floats = NDArray[np.float64]

_MOST_DOUBLINGS = 40
_CONVERGED = 1e-5  # the next step's change is the square of that
LARGEST_VARIANCE_PX2 = 1e6
"""Variance of an invalid slope."""


class SlopePredictor:
    """Kalman filter of a `SlopeModel` for noisy measurements of z[k].

    The error of its predictions is the steady one, for slopes with their usual noise; how much each slope
    corrects follows the noise of each frame.

    Parameters
    ----------
    model : SlopeModel
    variance_px2 : (m,) array
        Usual variance of the slopes' noise.
    covariance_xy_px2 : (m / 2,) array, optional
        Usual covariance of the noise of x and y of each sub-aperture. Default: 0.
    steady : bool
        Whether the gain does not follow the noise of frames: one product with a matrix, much less work.
    covariance : (states, states) array, optional
        What `steady_covariance` gives, where it is known already.
    """

    def __init__(
        self,
        model: SlopeModel,
        variance_px2: Floats,
        covariance_xy_px2: Floats | None = None,
        *,
        steady: bool = False,
        covariance: Floats | None = None,
    ) -> None:
        self.model, self._steady = model, steady
        if covariance is None:
            covariance = steady_covariance(model, variance_px2, covariance_xy_px2)
        self.covariance = covariance
        """(states, states): covariance of the state's error before a measurement."""
        self.with_slopes = self.covariance @ model.observation.T
        """(states, m): covariance of the errors of state and slopes."""
        self.predicted_px2 = model.observation @ self.with_slopes
        """(m, m): covariance of the predicted slopes' error."""
        self.usual_px2 = self.predicted_px2.copy()
        add_noise(self.usual_px2, np.minimum(variance_px2, LARGEST_VARIANCE_PX2), covariance_xy_px2)
        """(m, m): covariance of measured slopes about the prediction, with their usual noise."""
        self._gain = np.linalg.solve(self.usual_px2, self.with_slopes.T).T
        self.state = np.zeros(model.states)
        self._correction = np.zeros(model.states)
        self._ahead: dict[int, Floats] = {}

    @property
    def mean_px(self) -> Floats:
        """(m,): predicted open-loop slopes of the next frame."""
        return np.asarray(self._of_layers[:, 0].sum(axis=0))

    @property
    def std_px(self) -> Floats:
        """(m,): standard deviations of the prediction."""
        return np.asarray(np.sqrt(np.diag(self.predicted_px2)))

    @property
    def _of_layers(self) -> Floats:
        """(layers, 2, m): the state."""
        return self.state.reshape(self.model.layers, 2, self.model.slopes)

    def ahead(self, frames: int) -> Floats:
        """Return (m,): the slopes predicted for a number of frames after the current one."""
        if frames not in self._ahead:
            self._ahead[frames] = self.model.ahead(frames)
        return np.asarray(self._ahead[frames] @ self.state)

    def begin(self, slopes_px: Floats) -> None:
        """Restart from constant open-loop slopes."""
        self._of_layers[:] = shares(self.model)[:, None, None] * slopes_px

    def correct(
        self, slopes_px: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """Update with the measured open-loop slopes of this frame; infinite variance: invalid.

        `covariance_xy_px2` (m / 2,) are covariances of the noise of x and y; a steady filter has none.
        """
        surprise = slopes_px - self.mean_px
        if self._steady:
            surprise[~np.isfinite(variance_px2)] = 0.0
            np.matmul(self._gain, surprise, out=self._correction)
        else:
            variance = np.minimum(variance_px2, LARGEST_VARIANCE_PX2)
            surprise[variance >= LARGEST_VARIANCE_PX2] = 0.0
            total = self.predicted_px2.copy()
            add_noise(total, variance, covariance_xy_px2)
            np.matmul(self.with_slopes, np.linalg.solve(total, surprise), out=self._correction)
        self.state += self._correction

    def advance(self) -> None:
        """Predict the next frame."""
        layers = self._of_layers
        predicted = np.matmul(self.model.both, self.state.reshape(len(layers), -1, 1))[:, :, 0]
        layers[:, 1] = layers[:, 0]
        layers[:, 0] = predicted


def shares(model: SlopeModel) -> Floats:
    """Return the a priori share of each layer in the slopes, (layers,)."""
    driving = np.trace(model.driving, axis1=1, axis2=2)
    return np.asarray(driving / driving.sum())


def steady_covariance(
    model: SlopeModel, variance_px2: Floats, covariance_xy_px2: Floats | None = None
) -> Floats:
    """Return the steady-state covariance (states, states) of the predicted state's error.

    The discrete algebraic Riccati equation by doubling (Chu, Fan & Lin 2005, Linear Algebra Appl. 396, 55):
    twice as many frames with each step.
    """
    n, m = model.states, model.slopes
    observation, variance = model.observation, np.minimum(variance_px2, LARGEST_VARIANCE_PX2)
    step = model.onward.T  # transposed: of the dual problem
    informed = observation.T @ weighted_slopes(observation, variance, covariance_xy_px2)
    error = np.zeros((n, n))
    for layer, driving in enumerate(model.driving):
        rows = slice(2 * m * layer, 2 * m * layer + m)
        error[rows, rows] = driving
    identity = np.eye(n)
    for _ in range(_MOST_DOUBLINGS):
        solved = np.linalg.solve(identity + informed @ error, np.hstack([step, informed]))
        change = step.T @ error @ solved[:, :n]
        informed = informed + step @ solved[:, n:] @ step.T
        step = step @ solved[:, :n]
        error = error + 0.5 * (change + change.T)
        if np.abs(change).max() <= _CONVERGED * np.abs(error).max():
            break
    return np.asarray(error)
