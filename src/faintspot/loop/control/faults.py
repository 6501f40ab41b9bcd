"""Sub-apertures that measure nothing, and actuators that do not move.

The slopes of such a sub-aperture are constant, take two or three values, or follow those of another one.
Their noise would look small, so that a filter would trust them most of all. The commands of such an actuator
grow.
"""

import itertools
import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.slopes.kernels.compiling import Direct, compiled_with

Mask = NDArray[np.bool_]

STUCK_FRAMES = 50
"""Frames with three values at most after which a slope counts as stuck, and with others until it is not."""
_VALUES, _LATEST, _FEWEST_REPEATED = (
    3,
    4,
    8,
)  # rows of values and of the latest; fewer slopes may repeat by chance
_STILL, _WANDERS = 0.5, 10.0
"""Response and variance of the commands of an actuator that does not move, in those of the median one."""
_SILENT = 0.25  # part of the median response of slopes below which a sub-aperture does not see the wavefront
_SURE = 2.0  # standard errors
# After one frame the noise of both is the same: there, the steps before stand for those sent. So it is where
# no later response of the median actuator is as large as the second number.
_DELAYS, _LATER = range(2, 6), 0.15
_RIDGE, _RCOND = 1e-3, 0.05
_FEW_SLOPES, _BY_CHANCE = 8, 5.0  # slopes whose values are counted; repeats in those of equally likely values
_ALIKE = 1e-9  # difference of two slopes that follow each other, in their standard deviations
# In the loop: frames after which slopes are compared (those alike twice in a row follow each other), the
# largest part of them that may, and a sequence in [0, 1) on which they are projected.
_BLOCK, _MOST_ALIKE, _SEQUENCE = 64, 0.25, 0.6180339887498949
# Rows of a table: sums of the slopes, their squares and products with the sequence; the slope that is alike,
# how often it was once more, and what is equal for both.
_SUM, _SQUARES, _PROJECTION, _PARTNER, _TIMES, _KEY = range(6)


@partial(compiled_with, source=__file__)
def _compare(slopes: Any, sums: Any, clock: Any, table: Any) -> None:
    """Find slopes that follow each other, whose equal keys meet in a hash table; see `StuckWatch`."""
    m, value = slopes.shape[0], (clock[1] * _SEQUENCE) % 1.0
    clock[0] += 1.0
    clock[1] += 1.0
    clock[2] += value
    for s in range(m):
        sums[_SUM, s] += slopes[s]
        sums[_SQUARES, s] += slopes[s] * slopes[s]
        sums[_PROJECTION, s] += slopes[s] * value
    if clock[0] < _BLOCK:
        return
    mean, alike = clock[2] / clock[0], 0
    for i in range(table.shape[0]):
        table[i] = -1
    for s in range(m):
        average = sums[_SUM, s] / clock[0]
        variance = sums[_SQUARES, s] / clock[0] - average * average
        key, before, partner = 0.0, sums[_PARTNER, s], -1
        if variance > 1e-9 * average * average:
            key = abs(sums[_PROJECTION, s] / clock[0] - average * mean) / math.sqrt(variance)
            place = int(key * 1e6) * 7919 % table.shape[0]
            while table[place] >= 0 and partner < 0:
                if abs(sums[_KEY, table[place]] - key) < _ALIKE:
                    partner = table[place]
                place = (place + 1) % table.shape[0]
            if partner < 0:
                table[place] = s
        sums[_KEY, s], sums[_PARTNER, s] = key, partner
        sums[_TIMES, s] = sums[_TIMES, s] + 1.0 if partner >= 0 and partner == before else 0.0
        alike += partner >= 0
        sums[_SUM, s] = sums[_SQUARES, s] = sums[_PROJECTION, s] = 0.0
    clock[0] = clock[2] = 0.0
    if alike > _MOST_ALIKE * m:
        for s in range(m):
            sums[_TIMES, s] = 0.0


@partial(compiled_with, source=__file__)
def _watch(slopes: Any, errors: Any, recent: Any, sums: Any, used: Any) -> float:
    """Write the errors of slopes, infinite for sub-apertures that measure nothing; see `StuckWatch`.

    Return the mean square of slopes that are not used but change, in that of those that are used.
    """
    m, left_out, others, size, inside = slopes.shape[0], 0.0, 0.0, 0.0, 0.0
    seen = fresh = 0
    for s in range(m):
        used[s] = math.inf
        if errors[s] < math.inf:
            seen, fresh = seen + 1, fresh + (slopes[s] != recent[_LATEST, s])
            recent[_LATEST, s] = slopes[s]
    if seen > _FEWEST_REPEATED and fresh == 0:  # the camera has sent a frame again
        return 0.0
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
        if sums[_TIMES, s] > 0:
            for one in (s, int(sums[_PARTNER, s])):
                used[one] = used[(one + m // 2) % m] = math.inf
    for s in range(m):
        if max(recent[_VALUES, s], recent[_VALUES, (s + m // 2) % m]) > STUCK_FRAMES:
            used[s] = math.inf
        elif used[s] < math.inf:
            inside, size = inside + 1.0, size + slopes[s] * slopes[s]
        elif slopes[s] != 0.0:
            others, left_out = others + 1.0, left_out + slopes[s] * slopes[s]
    return left_out * inside / max(size * others, 1e-300) if inside > 0.0 else 0.0


_WATCH, _COMPARE = Direct(_watch), Direct(_compare)


class StuckWatch:
    """Find the sub-apertures whose slopes stick or follow those of another one exactly, frame by frame.

    Parameters
    ----------
    slopes : int
        Number of slopes, all x, then all y.
    """

    def __init__(self, slopes: int) -> None:
        self._recent = np.full((_LATEST + 1, slopes), np.nan)
        self._recent[_VALUES] = 0.0
        self._sums, self._clock = np.zeros((_KEY + 1, slopes)), np.zeros(3)
        self._table = np.empty(2 * slopes, np.int64)
        self.used = np.zeros(slopes)
        """(2 n,): standard errors of the latest frame, infinite for sub-apertures that measure nothing."""
        self.left_out = 0.0
        """Mean square of the slopes that are not used but change, in that of those that are used."""

    @property
    def sticks(self) -> Mask:
        """(n,): whether the slopes of each sub-aperture stick."""
        return np.asarray((self._recent[_VALUES] > STUCK_FRAMES).reshape(2, -1).any(axis=0))

    @property
    def is_stuck(self) -> Mask:
        """(n,): whether each sub-aperture sticks, follows another one or is followed."""
        follows = self._sums[_TIMES] > 0
        partners = self._sums[_PARTNER][follows].astype(np.int64)
        follows[partners] = True
        return np.asarray(self.sticks | follows.reshape(2, -1).any(axis=0))

    def __call__(self, slopes: Floats, errors: Floats) -> Floats:
        """Return the standard errors to use for the slopes of a frame, which are finite."""
        arrays = np.ascontiguousarray(slopes, np.float64), np.ascontiguousarray(errors, np.float64)
        _COMPARE(arrays[0], self._sums, self._clock, self._table)
        self.left_out = _WATCH(*arrays, self._recent, self._sums, self.used)
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
            stuck[frame] |= watch.sticks
    return stuck


def rows_without_measurement(slopes: Floats) -> Mask:
    """Return the frames whose slopes are all 0, not measured, or those of an earlier frame, (frames,).

    Few coarse slopes repeat by chance: such rows count as measured.

    Parameters
    ----------
    slopes : (frames, m) array
        NaN where not measured.
    """
    rows = np.where(np.isfinite(slopes), slopes, 0.0) + 0.0  # -0.0 is 0.0
    _, first = np.unique([hash(row.tobytes()) for row in rows], return_index=True)
    is_none = np.isin(np.arange(len(rows)), first, invert=True) | ~rows.any(axis=1)
    moving = rows[:, np.ptp(rows, axis=0) > 0][:, :_FEW_SLOPES]
    states = math.prod(float(len(np.unique(values))) for values in moving.T)
    by_chance = _BY_CHANCE * np.count_nonzero(np.isfinite(slopes).any(axis=1)) ** 2 / states
    return np.asarray(is_none if is_none.sum() > by_chance else ~np.isfinite(slopes).any(axis=1))


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


def silent_subapertures(slopes: Floats, steps: Floats) -> Mask:
    """Return the sub-apertures whose slopes neither take part in steps of the mirror nor answer them, (n,).

    Whatever law computed the steps, slopes of a wavefront are a part of them, and change with them later. If
    more than a quarter seem to be silent, the matrix is another one, and none is returned.

    Parameters
    ----------
    slopes : (frames, 2 n) array
        NaN where not measured.
    steps : (frames - 1, 2 n) array
        Steps of the commands that were computed from all but the first, in slopes.
    """
    change = np.diff(slopes, axis=0)
    later = [_responses(change[delay:], steps[:-delay]) for delay in _DELAYS]
    later = [fit for fit in later if fit[2] > _LATER]
    silent = np.zeros(slopes.shape[1] // 2, np.bool_)
    for response, error, usual in [
        _responses(-slopes[1:], steps),
        *sorted(later, key=lambda fit: -fit[2])[:1],
    ]:
        found = np.abs(response) + _SURE * error < _SILENT * abs(usual)
        silent |= found & (found.mean() <= _MOST_ALIKE)
    return silent


def _responses(slopes: Floats, steps: Floats) -> tuple[Floats, Floats, float]:
    """Return regressions of slopes on steps by sub-aperture, their errors, and their median."""
    measured = np.isfinite(slopes)
    sent, seen = np.where(measured, steps, 0.0), np.where(measured, slopes, 0.0)
    seen -= np.where(measured, seen.sum(axis=0) / np.maximum(measured.sum(axis=0), 1), 0.0)
    power, size, product = (
        (one * other).reshape(len(slopes), 2, -1).sum(axis=(0, 1))
        for one, other in ((sent, sent), (seen, seen), (sent, seen))
    )
    known = power > 0
    response = np.where(known, product / np.where(known, power, 1.0), 0.0)
    error = np.where(known, np.sqrt(size / np.where(known, power, 1.0) / max(len(slopes), 1)), math.inf)
    return response, error, float(np.median(response[known])) if known.any() else 0.0


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
    if usual < _LATER:
        moved = change[2:] @ np.linalg.pinv(interaction, rcond=_RCOND).T
        before, sent = steps[:-2] - steps[:-2].mean(axis=0), steps[1:-1]
        common = (before * sent).sum(axis=0)
        common[common == 0.0] = np.inf  # of commands that are constant
        response = (before * moved).sum(axis=0) / common
        spread = (moved - response * sent).std(axis=0)
        usual, error = 1.0, np.sqrt(np.square(before).sum(axis=0)) * spread / np.abs(common)
    variance = commands.var(axis=0)
    is_still = np.abs(response) + _SURE * error < _STILL * usual
    return np.asarray(is_still & (variance > _WANDERS * np.median(variance)))
