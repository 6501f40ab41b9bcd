"""Kalman filter that predicts open-loop slopes, and its model: a vector autoregression of second order."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import scipy

from faintspot.base.arrays import Floats
from faintspot.loop.control.reconstructor import add_noise, weighted_slopes

_RIDGE = 1e-4  # of a slope's variance: what noise-free theory would demand of single slopes is not asked
_LEAST_DRIVING = 1e-6  # of a slope's variance


MOST_SLOPES = 300
"""Slopes of a sensor whose filter lets each correct all others; of more, near ones alone."""


@dataclass(frozen=True, eq=False)
class SlopeModel:
    """z[k] = sum over layers of y[k]; y[k + 1] = first y[k] + second y[k - 1] + e[k], E[e e^T] = driving.

    The state is [y[k], y[k - 1]] of every layer, one layer after the other.
    """

    first: Floats
    """(layers, m, m)"""
    second: Floats
    """(layers, m, m)"""
    driving: Floats
    """(layers, m, m) px^2"""

    @classmethod
    def of_covariances(cls, covariances_px2: Floats) -> Self:
        """Return the model of slopes with given covariances (Yule-Walker).

        Parameters
        ----------
        covariances_px2 : (layers, 3, m, m) or (3, m, m) array
            E[y[k + lag] y[k]^T] of each layer for lags of 0, 1 and 2 frames.
        """
        lags = covariances_px2.shape[-3:]
        layers = [_regression(_joint_moments(moments)) for moments in covariances_px2.reshape(-1, *lags)]
        return cls(*(np.array(matrices) for matrices in zip(*layers, strict=True)))

    @property
    def layers(self) -> int:
        """Number of layers."""
        return len(self.first)

    @property
    def slopes(self) -> int:
        """Number of slopes, m."""
        return int(self.first.shape[1])

    @property
    def states(self) -> int:
        """Length of the state, 2 m for each layer."""
        return 2 * self.layers * self.slopes

    @cached_property
    def both(self) -> Floats:
        """(layers, m, 2 m): `first` beside `second`."""
        return np.concatenate([self.first, self.second], axis=2)

    @cached_property
    def onward(self) -> Floats:
        """(states, states): transition matrix of the state."""
        step = np.eye(2 * self.slopes, k=-self.slopes)
        blocks = np.repeat(step[None], self.layers, axis=0)
        blocks[:, : self.slopes] = self.both
        return np.asarray(scipy.linalg.block_diag(*blocks))

    @cached_property
    def observation(self) -> Floats:
        """(m, states): matrix from the state to z[k]."""
        return np.tile(np.eye(self.slopes, 2 * self.slopes), self.layers)

    def ahead(self, frames: int) -> Floats:
        """Return (m, states): matrix from the state to z a number of frames later."""
        matrix = self.observation
        for _ in range(frames):
            matrix = matrix @ self.onward
        return matrix

    def spread(self, covariance: Floats, frames: int) -> Floats:
        """Return the covariance (states, states) of the state's error a number of frames later."""
        driving = np.concatenate([self.driving, np.zeros_like(self.driving)])
        order = np.arange(2 * self.layers).reshape(2, -1).T.ravel()
        added = scipy.linalg.block_diag(*driving[order])
        for _ in range(frames):
            covariance = self.onward @ covariance @ self.onward.T + added
        return covariance


def _regression(moments_px2: Floats) -> tuple[Floats, Floats, Floats]:
    """Return `first`, `second` and `driving` of one layer, (m, m), for moments (3 m, 3 m)."""
    m = len(moments_px2) // 3
    variance = np.trace(moments_px2) / (3 * m)
    past, onward = moments_px2[m:, m:], moments_px2[:m, m:]
    weights = np.linalg.solve(past + _RIDGE * variance * np.eye(2 * m), onward.T).T
    driving = moments_px2[:m, :m] - weights @ onward.T - onward @ weights.T + weights @ past @ weights.T
    return weights[:, :m], weights[:, m:], _positive(driving, _LEAST_DRIVING * variance)


def _joint_moments(covariances_px2: Floats) -> Floats:
    """Return second moments (3 m, 3 m) of z[k + 1], z[k], z[k - 1], from covariances (3, m, m)."""
    same, one, two = covariances_px2
    return np.block([[same, one, two], [one.T, same, one], [two.T, one.T, same]])


def _positive(matrix: Floats, least: float) -> Floats:
    """Return the symmetric part of a matrix with no eigenvalue below `least`."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    if values[0] >= least:
        return np.asarray(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)


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

    def matrices(self, frames: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Return transition, correction by the usual noise, observation and slopes so many frames ahead.

        Shapes: (states, states), (states, m) and twice (m, states).
        """
        model = self.model
        return model.onward, np.asarray(self._gain), model.observation, model.ahead(frames)

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
