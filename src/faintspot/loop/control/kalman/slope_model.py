"""Temporal models of open-loop slopes: vector autoregressions of second order.

The slopes are the sum of those of layers, which evolve independently. What blows with one wind is far
easier to predict than the sum of several; where winds are not known, one layer stands for all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

Floats = NDArray[np.float64]

_RIDGE = 1e-4  # of a slope's variance: what noise-free theory would demand of single slopes is not asked
_LEAST_DRIVING = 1e-6  # of a slope's variance


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
        return np.asarray(block_diag(*blocks))

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
        added = block_diag(*driving[order])
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
