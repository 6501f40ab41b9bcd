"""Kalman filter of a `LocalModel`: each sub-aperture is corrected by those around it.

The work of a frame is proportional to the number of slopes.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.kalman.local_model import (
    Indices,
    at_most,
    local_gains,
    neighbours_within,
    of_slopes,
    replies,
    steady_covariance,
)
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2
from faintspot.loop.control.reconstructor import add_noise
from faintspot.loop.slope_covariance import SlopeTurbulence
from faintspot.slopes.kernels.compiling import Direct, compiled_with

_Singles = NDArray[np.float32]

_REACH_OF_COVARIANCE = 2.5
"""Sub-apertures from within which corrections come while the covariance is computed: more take much time."""
_REACHES = 6.0, 4.3, 3.2, 2.5
"""The same for the filter: the first with which errors die away. It is shorter for more sub-apertures."""
_MOST_REMAINING, _SETTLING_FRAMES, _SCORED_FRAMES = 0.9998, 2500, 500
NOISE_STEP = 2.0
_LEVELS = range(-3, 4)
_MOST_STATES = 22_000  # whose covariances take 8 GB while they are computed
_compiled = partial(compiled_with, source=__file__)


class LocalPredictor:
    """Predict open-loop slopes by a Kalman filter in which only sub-apertures near each other interact.

    Noise that changes from frame to frame selects one of a few gains, by its mean over the sensor.

    Parameters
    ----------
    arrays : mapping
        As from `local_filter`.
    """

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        self._arrays = arrays
        self._near, self._around = (
            np.ascontiguousarray(arrays[name], np.int32) for name in ("near", "around")
        )
        n = len(self._near)
        weights = np.asarray(arrays["weights"], np.float32)
        self._weights = np.ascontiguousarray(weights.transpose(1, 5, 3, 0, 2, 4))
        gains = np.asarray(arrays["corrections"], np.float32)
        self._gains = np.ascontiguousarray(gains.reshape(*gains.shape[:3], 2, -1).transpose(0, 1, 4, 3, 2))
        self._usual_px2 = np.asarray(arrays["variance_px2"], np.float64)
        self.std_px = np.sqrt(arrays["predicted_px2"])
        """(m,): standard deviations of the prediction."""
        self._shares = np.asarray(arrays["share"], np.float32)
        layers = len(weights)
        self._state = np.zeros((n + 1, 2, layers, 2), np.float32)
        self._later = np.zeros_like(self._state)
        self._surprise = np.zeros((n + 1, 2), np.float32)

    @property
    def mean_px(self) -> Floats:
        """(m,): predicted open-loop slopes of the next frame."""
        return _slopes(self._state)

    def begin(self, slopes_px: Floats) -> None:
        """Restart from constant open-loop slopes."""
        of_each = slopes_px.reshape(2, -1).T
        self._state[:-1] = self._shares[:, None] * of_each[:, None, None, :]

    def correct(
        self, slopes_px: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """Update with the measured open-loop slopes of this frame; infinite variance: invalid.

        The gains have the usual covariances of x and y.
        """
        surprise, level = self.surprise(slopes_px - self.mean_px, variance_px2)
        self._surprise[:-1] = surprise.reshape(2, -1).T
        _CORRECT(self._state, self._gains[level], self._around, self._surprise)

    def surprise(self, difference_px: Floats, variance_px2: Floats) -> tuple[Floats, int]:
        """Return what slopes differ from the prediction, 0 where not measured, and which gains to use.

        They are the gains for the mean noise of the slopes that were measured.
        """
        measured = variance_px2 < LARGEST_VARIANCE_PX2
        if not measured.any():
            return np.zeros_like(difference_px), 0
        more = np.log(variance_px2[measured] / self._usual_px2[measured]).mean() / math.log(NOISE_STEP)
        level = round(float(more)) + len(self._gains) // 2
        return np.where(measured, difference_px, 0.0), int(np.clip(level, 0, len(self._gains) - 1))

    def replies(self, frames: int) -> Iterable[Any]:
        """Return how predicted slopes answer to surprises, (m, m), for every set of gains."""
        return replies(self._arrays, frames)

    def failure(self, difference_px: Floats, variance_px2: Floats) -> float:
        """Return the mean square of what slopes differ from the prediction, in its expected deviation."""
        measured = variance_px2 < LARGEST_VARIANCE_PX2
        total = np.square(self.std_px) + variance_px2
        return float((np.square(difference_px) / total)[measured].sum() / max(measured.sum(), 1))

    def remaining(self, positions_m: Floats, level: int) -> float:
        """Return the part of an error that a frame leaves in the long run; the state is lost.

        Parameters
        ----------
        positions_m : (n, 2) array
            Of the sub-apertures.
        level : int
            Which gains.
        """
        rng, state = np.random.default_rng(1), self._state[:-1]
        pupil = np.column_stack([np.ones(len(positions_m)), positions_m / np.abs(positions_m).max()])
        state[:] = rng.standard_normal(state.shape)  # errors over short distances, and over the whole pupil
        state += np.tensordot(pupil, rng.standard_normal((3, *state.shape[1:])), 1)
        scored = 0.0
        for frame in range(_SETTLING_FRAMES + _SCORED_FRAMES):
            self._surprise[:-1] = -self.mean_px.reshape(2, -1).T
            _CORRECT(self._state, self._gains[level], self._around, self._surprise)
            self.advance()
            size = float(np.linalg.norm(self._state))
            self._state /= size
            scored += math.log(size) if frame >= _SETTLING_FRAMES else 0.0
        return math.exp(scored / _SCORED_FRAMES)

    def advance(self) -> None:
        """Predict the next frame."""
        _ADVANCE(self._state, self._weights, self._near, self._later)
        self._state, self._later = self._later, self._state

    def ahead(self, frames: int) -> Floats:
        """Return (m,): the slopes predicted for a number of frames later."""
        state = self._state
        for _ in range(frames):
            later = np.zeros_like(state)
            _ADVANCE(state, self._weights, self._near, later)
            state = later
        return _slopes(state)


def local_filter(
    layers: Sequence[SlopeTurbulence],
    frame_s: float,
    variance_px2: Floats,
    progress: Callable[[], None] | None = None,
    covariance_xy_px2: Floats | None = None,
) -> dict[str, Floats]:
    """Return the arrays of a `LocalPredictor` for frozen layers.

    Where memory is too small for all layers, weak ones join others: more than four of 40 x 40 sub-apertures.

    Parameters
    ----------
    layers : sequence of SlopeTurbulence
    frame_s : float
        Time between two frames.
    variance_px2 : (m,) array
        Usual variance of the slopes' noise.
    progress : callable, optional
        See `steady_covariance`.
    covariance_xy_px2 : (m / 2,) array, optional
        Usual covariance of the noise of x and y of each sub-aperture. Default: 0.

    Returns
    -------
    dict
        near (n, k), around (n, c): sub-apertures by which each is predicted and corrected. weights
        (layers, n, 2, 2, 2, k), corrections (levels, n, 4 layers, 2 c): see `LocalModel`, `local_gains`.
        variance_px2, predicted_px2 (m,): of noise and of the prediction's error. share (layers,).
    """
    layers = at_most(layers, max(1, _MOST_STATES // (2 * len(variance_px2))))
    positions, side = layers[0].positions_m, layers[0].subaperture_m
    near = neighbours_within(positions, _REACH_OF_COVARIANCE * side)
    model, covariance = steady_covariance(layers, frame_s, variance_px2, near, progress, covariance_xy_px2)
    with_slopes, predicted = of_slopes(covariance, model.layers)
    del covariance
    arrays = {
        "near": model.neighbours,
        "weights": model.weights.astype(np.float32),
        "variance_px2": variance_px2,
        "predicted_px2": np.diag(predicted).copy(),
        "share": model.variance_px2 / model.variance_px2.sum(),
    }

    def corrections(around: Indices, levels: Iterable[int]) -> Floats:
        gains = []
        for level in levels:
            measured, factor = predicted.copy(), NOISE_STEP**level
            covariance_xy = None if covariance_xy_px2 is None else factor * covariance_xy_px2
            add_noise(measured, np.minimum(factor * variance_px2, LARGEST_VARIANCE_PX2), covariance_xy)
            gains.append(local_gains(with_slopes, measured, around))
        return np.array(gains, np.float32)

    for reach in _REACHES:
        around = neighbours_within(positions, reach * side)
        tried = LocalPredictor(
            {**arrays, "around": around, "corrections": corrections(around, (_LEVELS[0], 0))}
        )
        if all(tried.remaining(positions, level) < _MOST_REMAINING for level in range(2)):
            break
    return {**arrays, "around": around, "corrections": corrections(around, _LEVELS)}


def local_shapes(arrays: Mapping[str, Any], slopes: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes that the arrays of a filter must have, given its numbers of neighbours and layers."""
    n, layers = slopes // 2, len(np.atleast_1d(arrays["share"]))
    near, around = (np.shape(arrays[name])[-1] for name in ("near", "around"))
    return {
        "near": (n, near),
        "around": (n, around),
        "weights": (layers, n, 2, 2, 2, near),
        "corrections": (len(_LEVELS), n, 4 * layers, 2 * around),
        "predicted_px2": (slopes,),
        "share": (layers,),
    }


def _slopes(state: _Singles) -> Floats:
    """Return the slopes (m,) of a state."""
    total = np.zeros((len(state) - 1, 2))
    for layer in range(state.shape[2]):  # faster than a sum over an axis as short as this
        total += state[:-1, 0, layer]
    return total.T.ravel()


@_compiled
def _correct(state: _Singles, gains: _Singles, around: NDArray[np.int32], surprise: _Singles) -> None:
    """Add to the state of each sub-aperture what the surprise around it tells.

    Parameters
    ----------
    state : (n + 1, 2, layers, 2) float32
    gains : (n, c, 2, 4 layers) float32
    around : (n, c) int32
    surprise : (n + 1, 2) float32
        The last row is 0.
    """
    flat = state.reshape(state.shape[0], gains.shape[3])
    for i in range(around.shape[0]):
        values = flat[i]
        for j in range(around.shape[1]):
            x, y = surprise[around[i, j], 0], surprise[around[i, j], 1]
            of_x, of_y = gains[i, j, 0], gains[i, j, 1]
            for s in range(values.shape[0]):
                values[s] += of_x[s] * x + of_y[s] * y


@_compiled
def _advance(state: _Singles, weights: _Singles, near: NDArray[np.int32], later: _Singles) -> None:
    """Write the state of the next frame.

    Parameters
    ----------
    state, later : (n + 1, 2, layers, 2) float32
        The last row is 0.
    weights : (n, k, 2, layers, 2, 2) float32
        From this frame and the one before, to x and y, from x and y.
    near : (n, k) int32
    """
    for i in range(near.shape[0]):
        for layer in range(state.shape[2]):
            x = y = np.float32(0.0)
            for j in range(near.shape[1]):
                for time in range(2):
                    w, slopes = weights[i, j, time, layer], state[near[i, j], time, layer]
                    from_x, from_y = slopes[0], slopes[1]
                    x += w[0, 0] * from_x + w[0, 1] * from_y
                    y += w[1, 0] * from_x + w[1, 1] * from_y
            later[i, 1, layer, 0], later[i, 1, layer, 1] = state[i, 0, layer, 0], state[i, 0, layer, 1]
            later[i, 0, layer, 0], later[i, 0, layer, 1] = x, y


_CORRECT, _ADVANCE = Direct(_correct), Direct(_advance)
