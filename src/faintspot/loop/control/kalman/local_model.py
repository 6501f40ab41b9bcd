"""Temporal model of open-loop slopes in which each slope follows from those of neighbouring sub-apertures.

Between two frames the wind carries turbulence over a small part of a sub-aperture, so that a layer's slopes
follow almost entirely from the same and the adjacent sub-apertures in the two frames before. The work of a
frame is proportional to the number of slopes, that of `models.SlopeModel` to its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]

_REACH = 1.5  # sub-apertures: with the diagonal neighbours
_RIDGE = 1e-3  # of a slope's variance
_FADING = 1e-3  # of the turbulence in a step: what slopes do not show, like layers that cancel, dies away
_LEAST_DRIVING = 1e-6  # of a slope's variance
_AT_ONCE = 64  # sub-apertures whose equations are solved together: more would take more memory


@dataclass(frozen=True, eq=False)
class LocalModel:
    """z[k] = sum over layers of y[k]; y[k + 1] follows from y[k] and y[k - 1] of neighbours, and noise."""

    neighbours: Indices
    """(n, k): sub-apertures that each follows from; `n` where there are fewer."""
    weights: Floats
    """(layers, n, 2, 2, 2, k): of each slope (x, y), from this frame and the one before, from x and y."""
    driving: Floats
    """(layers, 2 n, 2 n) px^2: covariance of the noise."""
    variance_px2: Floats
    """(layers,): mean variance of a slope."""

    @classmethod
    def of_layers(cls, layers: Sequence[SlopeTurbulence], step_s: float) -> Self:
        """Return the model of frozen layers for frames `step_s` apart (Yule-Walker)."""
        positions = layers[0].positions_m
        near = neighbours_within(positions, _REACH * layers[0].subaperture_m)
        regressions = [_regression(layer.lagged_px2(step_s), near) for layer in layers]
        return cls(near, *(np.array(values) for values in zip(*regressions, strict=True)))

    @property
    def layers(self) -> int:
        """Number of layers."""
        return len(self.weights)

    @property
    def slopes(self) -> int:
        """Number of slopes, 2 n."""
        return 2 * len(self.neighbours)


def at_most(layers: Sequence[SlopeTurbulence], count: int) -> list[SlopeTurbulence]:
    """Return as many layers or fewer: the weakest joins that with the nearest wind, until they are few."""
    kept = list(layers)
    while len(kept) > count:
        weakest = kept.pop(int(np.argmax([layer.r0_m for layer in kept])))
        distances = [np.hypot(*(layer.wind_m_per_s - weakest.wind_m_per_s)[0]) for layer in kept]
        nearest = int(np.argmin(distances))
        strength = np.array([layer.r0_m ** (-5 / 3) for layer in (kept[nearest], weakest)])
        winds = np.concatenate([kept[nearest].wind_m_per_s, weakest.wind_m_per_s])
        kept[nearest] = replace(
            kept[nearest],
            r0_m=float(strength.sum() ** (-3 / 5)),
            wind_m_per_s=(strength @ winds / strength.sum())[None],
        )
    return kept


def neighbours_within(positions_m: Floats, distance_m: float) -> Indices:
    """Return the sub-apertures within a distance of each, nearest first, (n, k); `n` fills shorter rows."""
    n = len(positions_m)
    apart = np.hypot(*(positions_m[:, None] - positions_m).transpose(2, 0, 1))
    order = np.argsort(apart, axis=1, kind="stable").astype(np.int32)
    within = np.take_along_axis(apart, order, axis=1) <= distance_m * (1 + 1e-9)
    return np.ascontiguousarray(np.where(within, order, np.int32(n))[:, : int(within.sum(axis=1).max())])


def both_axes(neighbours: Indices, n: int) -> Indices:
    """Return the indices of x and y slopes of neighbours, (n, 2 k), 2 n where there is none."""
    exists = neighbours < n
    return np.concatenate([np.where(exists, neighbours + shift, 2 * n) for shift in (0, n)], axis=1)


def solve_locally(matrix: Floats, right: Floats, chosen: Indices, ridge: float = 0.0) -> Floats:
    """Return x (n, rows, k) with x[i] matrix[chosen[i], chosen[i]] = right[i][:, chosen[i]], 0 where none.

    Parameters
    ----------
    matrix : (m, m) array
    right : (n, rows, m) array
    chosen : (n, k) array
        Indices; m where there is none.
    ridge : float
        Added to the diagonal.
    """
    m, (n, k) = len(matrix), chosen.shape
    diagonal, solution = np.arange(k), np.empty((n, right.shape[1], k))
    for part in (slice(start, start + _AT_ONCE) for start in range(0, n, _AT_ONCE)):
        exists = chosen[part] < m
        index = np.where(exists, chosen[part], 0)
        pairs = exists[:, :, None] & exists[:, None, :]
        local = np.where(pairs, matrix[index[:, :, None], index[:, None, :]], 0.0)
        local[:, diagonal, diagonal] += np.where(exists, ridge, 1.0)
        values = np.take_along_axis(right[part], index[:, None, :], axis=2)
        right_ = np.where(exists[:, None, :], values, 0.0)
        solution[part] = np.linalg.solve(local, right_.swapaxes(1, 2)).swapaxes(1, 2)
    return solution


def _regression(covariances_px2: Floats, near: Indices) -> tuple[Floats, Floats, float]:
    """Return weights (n, 2, 2, 2, k), driving noise and mean variance for lags of 0, 1 and 2 frames."""
    same, next_step, second_step = covariances_px2
    m, n = len(same), len(near)
    variance = float(np.trace(same)) / m
    past, onward = np.block([[same, next_step], [next_step.T, same]]), np.hstack([next_step, second_step])
    axes = both_axes(near, n)
    chosen = np.concatenate([np.where(axes < m, axes, 2 * m), np.where(axes < m, axes + m, 2 * m)], axis=1)
    targets = np.stack([onward[:n], onward[n:]], axis=1)
    weights = (1 - _FADING) * solve_locally(past, targets, chosen.astype(np.int32), _RIDGE * variance)
    driving = same - _explained(weights, chosen, past, onward)
    driving[np.diag_indices(m)] += _LEAST_DRIVING * variance
    return weights.reshape(n, 2, 2, 2, -1), 0.5 * (driving + driving.T), variance


def _explained(weights: Floats, chosen: Indices, past: Floats, onward: Floats) -> Floats:
    """Return the part of the covariance that the weights explain: what is left is that of their errors."""
    m = len(onward)
    matrix = np.zeros((m, 2 * m + 1))
    rows = np.arange(m).reshape(2, -1).T
    matrix[rows[:, :, None], chosen[:, None, :]] = weights
    matrix = matrix[:, :-1]
    cross = matrix @ onward.T
    return np.asarray(cross + cross.T - matrix @ past @ matrix.T)
