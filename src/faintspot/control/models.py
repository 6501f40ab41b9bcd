"""How open-loop slopes go on from frame to frame: a vector autoregression of second order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_RIDGE = 1e-4  # of a slope's variance: what noise-free theory would demand of single slopes is not asked
_LEAST_DRIVING = 1e-6  # of a slope's variance


@dataclass(frozen=True, eq=False)
class SlopeModel:
    """z[k + 1] = first z[k] + second z[k - 1] + e[k], with E[e e^T] = driving."""

    first: Floats
    """(m, m)"""
    second: Floats
    """(m, m)"""
    driving: Floats
    """(m, m) px^2"""

    @classmethod
    def of_covariances(cls, covariances_px2: Floats) -> Self:
        """Return the model of slopes with given covariances (Yule-Walker).

        Parameters
        ----------
        covariances_px2 : (3, m, m) array
            E[z[k + lag] z[k]^T] for lags of 0, 1 and 2 frames.
        """
        return cls.of_moments(joint_moments(covariances_px2))

    @classmethod
    def of_moments(cls, moments_px2: Floats) -> Self:
        """Return the regression of z[k + 1] on z[k], z[k - 1], with a small ridge.

        Parameters
        ----------
        moments_px2 : (3 m, 3 m) array
            Second moments of z[k + 1], z[k], z[k - 1].
        """
        m = len(moments_px2) // 3
        variance = np.trace(moments_px2) / (3 * m)
        past, onward = moments_px2[m:, m:], moments_px2[:m, m:]
        both = np.linalg.solve(past + _RIDGE * variance * np.eye(2 * m), onward.T).T
        left = moments_px2[:m, :m] - both @ onward.T - onward @ both.T + both @ past @ both.T
        return cls(both[:, :m], both[:, m:], _positive(left, _LEAST_DRIVING * variance))

    @property
    def slopes(self) -> int:
        """Number of slopes, m."""
        return len(self.first)

    @cached_property
    def both(self) -> Floats:
        """(m, 2 m): `first` beside `second`."""
        return np.hstack([self.first, self.second])

    def ahead(self, frames: int) -> Floats:
        """Return (m, 2 m): z so many frames after the state [z[k], z[k - 1]]."""
        m = self.slopes
        now, before = np.eye(m, 2 * m), np.eye(m, 2 * m, m)
        for _ in range(frames):
            now, before = self.first @ now + self.second @ before, now
        return now


def joint_moments(covariances_px2: Floats) -> Floats:
    """Return second moments (3 m, 3 m) of z[k + 1], z[k], z[k - 1], from covariances (3, m, m)."""
    same, one, two = covariances_px2
    return np.block([[same, one, two], [one.T, same, one], [two.T, one.T, same]])


def _positive(matrix: Floats, least: float) -> Floats:
    """Return the symmetric part of a matrix with no eigenvalue below `least`."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    if values[0] >= least:
        return np.asarray(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)
