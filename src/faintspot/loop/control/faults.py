"""Sub-apertures that measure nothing, and actuators that do not move.

The slopes of such a sub-aperture are constant, take two or three values, or follow those of another one.
Their noise would look small, so that a filter would trust them most of all. The commands of such an actuator
grow.
"""

from __future__ import annotations

import itertools
import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.kernels.compilation.compiling import Direct, compiled_with

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

STUCK_FRAMES = 50
"""Frames with three values at most after which a slope counts as stuck, and with others until it is not."""
_VALUES = 3
_STILL, _WANDERS = 0.5, 10.0
"""Response and variance of the commands of an actuator that does not move, in those of the median one."""
_SURE = 2.0  # standard errors
_DELAYS = range(2, 6)  # after one frame, the noise of both is the same
_RIDGE = 1e-3
_ALIKE = 1e-9  # difference of two slopes that follow each other, in their standard deviations


@partial(compiled_with, source=__file__)
def _watch(slopes: Any, errors: Any, recent: Any, used: Any) -> float:
    """Write the errors of slopes, infinite for sub-apertures that are stuck; see `StuckWatch`.

    Return the mean square of slopes that are not used but change, in that of those that are used.
    """
    m, left_out, others, size, inside = slopes.shape[0], 0.0, 0.0, 0.0, 0.0
    for s in range(m):
        used[s] = errors[s]
        if not (errors[s] < math.inf or slopes[s] != 0.0):  # 0 stands for a slope that is not known
            continue
        count, is_new = recent[_VALUES, s], True
        for number in range(_VALUES):
            is_new = is_new and recent[number, s] != slopes[s]
        if is_new:
            for number in range(_VALUES - 1, 0, -1):
                recent[number, s] = recent[number - 1, s]
            recent[0, s] = slopes[s]
            count = count - 1.0 if count > STUCK_FRAMES else 0.0
        else:
            count = min(count + 1.0, 2.0 * STUCK_FRAMES)
            count = 2.0 * STUCK_FRAMES if count >= STUCK_FRAMES else count
        recent[_VALUES, s] = 0.0 if count == STUCK_FRAMES else count
    for s in range(m):
        if max(recent[_VALUES, s], recent[_VALUES, (s + m // 2) % m]) > STUCK_FRAMES:
            used[s] = math.inf
        elif used[s] < math.inf:
            inside, size = inside + 1.0, size + slopes[s] * slopes[s]
        elif slopes[s] != 0.0:
            others, left_out = others + 1.0, left_out + slopes[s] * slopes[s]
    return left_out * inside / max(size * others, 1e-300) if inside > 0.0 else 0.0


_WATCH = Direct(_watch)


class StuckWatch:
    """Find the sub-apertures whose slopes stick, frame by frame.

    Parameters
    ----------
    slopes : int
        Number of slopes, all x, then all y.
    """

    def __init__(self, slopes: int) -> None:
        self._recent = np.full((_VALUES + 1, slopes), np.nan)
        self._recent[_VALUES] = 0.0
        self.used = np.zeros(slopes)
        """(2 n,): standard errors of the latest frame, infinite for sub-apertures that are stuck."""
        self.left_out = 0.0
        """Mean square of the slopes that are not used but change, in that of those that are used."""

    @property
    def is_stuck(self) -> Mask:
        """(n,): whether each sub-aperture is stuck."""
        return np.asarray((self._recent[_VALUES] > STUCK_FRAMES).reshape(2, -1).any(axis=0))

    def __call__(self, slopes: Floats, errors: Floats) -> Floats:
        """Return the standard errors to use for the slopes of a frame, which are finite."""
        arrays = np.ascontiguousarray(slopes, np.float64), np.ascontiguousarray(errors, np.float64)
        self.left_out = _WATCH(*arrays, self._recent, self.used)
        return self.used


def stuck_slopes(slopes: Floats) -> Mask:
    """Return which sub-apertures were stuck in the frames of a recording, (frames, n).

    Parameters
    ----------
    slopes : (frames, 2 n) array
        NaN where not measured.
    """
    measured = np.isfinite(slopes)
    known, errors = np.where(measured, slopes, 0.0), np.where(measured, 1.0, np.inf)
    stuck = np.zeros((len(slopes), slopes.shape[1] // 2), np.bool_)
    for order in (range(len(slopes)), range(len(slopes) - 1, -1, -1)):  # also before it is noticed
        watch = StuckWatch(slopes.shape[1])
        for frame in order:
            watch(known[frame], errors[frame])
            stuck[frame] |= watch.is_stuck
    return stuck


def followers(slopes: Floats) -> Mask:
    """Return the sub-apertures one of whose slopes follows that of another exactly, and those, (n,).

    Parameters
    ----------
    slopes : (frames, 2 n) array
        NaN where not measured.
    """
    measured = np.isfinite(slopes)
    count = np.maximum(measured.sum(axis=0), 1)
    centred = np.where(measured, slopes, 0.0)
    centred -= np.where(measured, centred.sum(axis=0) / count, 0.0)
    size = np.sqrt(np.square(centred).sum(axis=0) / count)
    centred /= np.maximum(size, 1e-300)
    # What is alike has the same projection on any vector.
    key = centred.T @ np.random.default_rng(1).standard_normal(len(slopes)) / math.sqrt(len(slopes))
    order = np.argsort(np.where(size > 0, key, np.arange(len(key)) + 1e3))
    alike = np.zeros(len(key), np.bool_)
    for one, other in itertools.pairwise(order):
        if key[other] - key[one] < _ALIKE and size[one] > 0 and size[other] > 0:
            alike[[one, other]] |= bool(np.abs(centred[:, one] - centred[:, other]).max() < 1e3 * _ALIKE)
    return np.asarray(alike.reshape(2, -1).any(axis=0))


def still_actuators(slopes: Floats, commands: Floats, interaction: Floats) -> Mask:
    """Return the actuators whose commands wander while the slopes do not follow their steps, (commands,).

    Parameters
    ----------
    slopes : (frames, 2 n) array
        0 where not measured.
    commands : (frames, commands) array
        Row k is computed from the slopes of row k.
    interaction : (2 n, commands) array
    """
    change, steps = np.diff(slopes, axis=0), np.diff(commands, axis=0)
    best: tuple[float, Floats, Floats] = -1.0, np.zeros(0), np.zeros(0)
    for delay in _DELAYS:
        later, sent = change[delay:], steps[:-delay]
        normal = (interaction.T @ interaction) * (sent.T @ sent)
        normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
        inverse = np.linalg.inv(normal)
        response = inverse @ ((later @ interaction) * sent).sum(axis=0)
        error = np.sqrt(np.square(later).mean() * np.diag(inverse))
        best = max(best, (float(np.median(response)), response, error), key=lambda fit: fit[0])
    usual, response, error = best
    variance = commands.var(axis=0)
    is_still = np.abs(response) + _SURE * error < _STILL * usual
    return np.asarray(is_still & (variance > _WANDERS * np.median(variance)))
