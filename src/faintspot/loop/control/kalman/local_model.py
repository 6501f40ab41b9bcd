"""Temporal model in which each slope follows from those of neighbours; its error covariance and gains.

Between two frames the wind carries turbulence over a small part of a sub-aperture, so that a layer's slopes
follow almost entirely from the same and the adjacent sub-apertures in the two frames before. The work of a
frame is proportional to the number of slopes, that of `models.SlopeModel` to its square.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from faintspot.base.arrays import Floats
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2
from faintspot.loop.control.reconstructor import add_noise
from faintspot.loop.slope_covariance import SlopeTurbulence

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


Singles = NDArray[np.float32]
Noise = tuple[Floats, Floats | None]
"""Variances of slopes (m,), and covariances of x and y (m / 2,), px^2."""

STEPS = (8, 8), (1, 12)
"""Frames that count as one, and number of such steps: long steps converge soon, the last ones are exact."""


def steady_covariance(
    layers: Sequence[SlopeTurbulence],
    frame_s: float,
    variance_px2: Floats,
    neighbours: Indices,
    progress: Callable[[], None] | None = None,
    covariance_xy_px2: Floats | None = None,
) -> tuple[LocalModel, Singles]:
    """Return the model for single frames, and the covariance (states, states) px^2 of its prediction's error.

    The state is y[k] of every layer, then y[k - 1] of every layer, each all x, then all y. The recursion
    runs from the turbulence's own covariance, first with the mean of several frames as one. It follows the
    error that the gains of `local_gains` leave (Joseph's form): the covariance of the best gains is
    smaller, and gains made for it amplify errors with periods of about two times their reach.

    Parameters
    ----------
    layers : sequence of SlopeTurbulence
    frame_s : float
        Time between two frames.
    variance_px2 : (m,) array
        Variance of the slopes' noise.
    neighbours : (n, k) array
        By which each sub-aperture is corrected, as from `neighbours_within`.
    progress : callable, optional
        Called after each of the steps.
    covariance_xy_px2 : (m / 2,) array, optional
        Covariance of the noise of x and y of each sub-aperture. Default: 0.
    """
    covariance = _prior(layers, STEPS[0][0] * frame_s)
    for number, (frames, steps) in enumerate(STEPS):
        model = LocalModel.of_layers(layers, frames * frame_s)
        onward, driving = _transition(model.neighbours, model.weights), model.driving.astype(np.float32)
        variance = np.minimum(variance_px2, LARGEST_VARIANCE_PX2) / frames
        noise = variance, None if covariance_xy_px2 is None else covariance_xy_px2 / frames
        if number:  # what was before a long step is not known better than what is now
            half = len(covariance) // 2
            covariance = np.tile(covariance[:half, :half], (2, 2))
        for _ in range(steps):
            covariance = _next(covariance, onward, driving, noise, neighbours)
            if progress is not None:
                progress()
    return model, covariance


def of_slopes(covariance: Singles, layers: int) -> tuple[Floats, Floats]:
    """Return the covariance of the errors of state and slopes, (states, m), and of the slopes, (m, m)."""
    half = len(covariance) // 2
    m = half // layers
    with_slopes = covariance[:, :half].reshape(2 * half, layers, m).sum(axis=1, dtype=np.float64)
    slopes = with_slopes[:half].reshape(layers, m, m).sum(axis=0)
    return with_slopes, 0.5 * (slopes + slopes.T)


def local_gains(with_slopes: Floats, measured_px2: Floats, neighbours: Indices) -> Floats:
    """Return how the states of each sub-aperture are corrected, (n, 4 layers, 2 k).

    Rows are y[k], then y[k - 1] of every layer, x and y; columns the x, then the y slopes of neighbours. Each
    sub-aperture is corrected as if there were no others, so that only small equations are solved.

    Parameters
    ----------
    with_slopes : (states, m) array
        As from `of_slopes`.
    measured_px2 : (m, m) array
        Covariance of the predicted slopes' error and of the noise.
    neighbours : (n, k) array
        As from `neighbours_within`.
    """
    n = len(neighbours)
    rows = with_slopes.reshape(-1, n, 2 * n).swapaxes(0, 1)
    return solve_locally(measured_px2, rows, both_axes(neighbours, n))


def replies(arrays: Mapping[str, Any], frames: int) -> Iterator[sparse.csr_matrix]:
    """Return for each set of gains how predicted slopes answer to surprises, (m, m).

    Parameters
    ----------
    arrays : mapping
        As from `local_filter`.
    frames : int
        For how many frames later the slopes are predicted.
    """
    ahead = slopes_ahead(arrays, frames)
    for gains in arrays["corrections"]:
        yield ahead @ _corrections(gains, arrays["around"])


def state_of_state(arrays: Mapping[str, Any]) -> sparse.csr_matrix:
    """Return the matrix (states, states) from a frame's state to the next; see `steady_covariance`."""
    onward = _transition(arrays["near"], arrays["weights"])
    return sparse.vstack([onward, sparse.eye(*onward.shape, dtype=np.float32)], "csr")


def state_of_surprise(arrays: Mapping[str, Any]) -> sparse.csr_matrix:
    """Return the matrix (states, m) that corrects the state at the usual noise."""
    levels = arrays["corrections"]
    return _corrections(levels[len(levels) // 2], arrays["around"])


def slopes_ahead(arrays: Mapping[str, Any], frames: int) -> sparse.csr_matrix:
    """Return the matrix (m, states) from a state to the slopes so many frames later."""
    onward, m, layers = state_of_state(arrays), 2 * len(arrays["near"]), len(arrays["weights"])
    each = sparse.eye(m, dtype=np.float32)
    ahead = sparse.hstack([each] * layers + [sparse.csr_matrix((m, m), dtype=np.float32)] * layers, "csr")
    for _ in range(frames):
        ahead = ahead @ onward
    return ahead


def _prior(layers: Sequence[SlopeTurbulence], step_s: float) -> Singles:
    """Return the covariance of the state before any measurement."""
    m = 2 * len(layers[0].positions_m)
    prior = np.zeros((2, len(layers), m, 2, len(layers), m), np.float32)
    for number, layer in enumerate(layers):
        same, next_step = layer.covariance_px2(), layer.covariance_px2(step_s)
        prior[0, number, :, 0, number] = prior[1, number, :, 1, number] = same
        prior[0, number, :, 1, number], prior[1, number, :, 0, number] = next_step, next_step.T
    return prior.reshape(2 * len(layers) * m, -1)


def _transition(neighbours: Indices, weights: Floats) -> sparse.csr_matrix:
    """Return the matrix (states / 2, states) from the state to y[k + 1]; for arguments see `LocalModel`."""
    n = len(neighbours)
    m, half = 2 * n, 2 * n * len(weights)
    exists = np.broadcast_to((neighbours < n)[:, None, None, None], weights.shape)
    layer, subaperture, axis, time, other_axis, index = np.nonzero(exists)
    neighbour = neighbours[subaperture, index]
    rows = layer * m + axis * n + subaperture
    columns = time * half + layer * m + other_axis * n + neighbour
    values = weights.astype(np.float32)[exists]
    return sparse.csr_matrix((values, (rows, columns)), shape=(half, 2 * half))


def _corrections(gains: Floats, neighbours: Indices) -> sparse.csr_matrix:
    """Return the matrix (states, m) from surprises to the state."""
    n, rows, _ = gains.shape
    columns = both_axes(neighbours, n)
    exists = np.broadcast_to((columns < 2 * n)[:, None], gains.shape)
    cell, row, index = np.nonzero(exists)
    return sparse.csr_matrix(
        (gains.astype(np.float32)[exists], (row * n + cell, columns[cell, index])), shape=(rows * n, 2 * n)
    )


def _next(
    covariance: Singles, onward: sparse.csr_matrix, driving: Singles, noise: Noise, neighbours: Indices
) -> Singles:
    """Return the covariance one step later: a measurement, then the prediction; the first is overwritten."""
    layers, m, _ = driving.shape
    half = layers * m
    with_slopes, slopes = of_slopes(covariance, layers)
    add_noise(slopes, *noise)
    gain = _corrections(local_gains(with_slopes, slopes, neighbours), neighbours)
    change = np.ascontiguousarray((0.5 * (gain @ slopes) - with_slopes).T, np.float32)
    _add_symmetric(covariance, gain, change)
    across = _product(onward, covariance)
    predicted = _product(onward, np.ascontiguousarray(across.T))
    predicted = 0.5 * (predicted + predicted.T)  # rounding errors that are not symmetric would grow
    blocks = predicted.reshape(layers, m, layers, m)
    for layer in range(layers):
        blocks[layer, :, layer] += driving[layer]
    after = np.empty_like(covariance)
    after[:half, :half], after[half:, half:] = predicted, covariance[:half, :half]
    after[:half, half:], after[half:, :half] = across[:, :half], across[:, :half].T
    return after


def _add_symmetric(covariance: Singles, left: sparse.csr_matrix, right: Singles) -> None:
    """Add left right and its transpose, in parts that a processor's cache holds."""
    for columns in _parts(len(covariance)):
        part = left @ np.ascontiguousarray(right[:, columns])
        covariance[:, columns] += part
        for rows in _parts(len(covariance)):
            covariance[columns, rows] += part[rows].T


def _product(left: sparse.csr_matrix, right: Singles) -> Singles:
    """Return left right, in parts that a processor's cache holds."""
    out = np.empty((left.shape[0], right.shape[1]), np.float32)
    for columns in _parts(right.shape[1]):
        out[:, columns] = left @ np.ascontiguousarray(right[:, columns])
    return out


def _parts(length: int) -> list[slice]:
    """Return slices of 512."""
    return [slice(start, start + 512) for start in range(0, length, 512)]
