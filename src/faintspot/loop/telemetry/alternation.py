"""Residual wavefront of each turn of a loop whose methods alternated, and their relative centroid gains.

The residual slopes of a turn are divided by the centroid gain of its method (`relative_gains`). The noise,
subtracted from the residual phase, is the deviation of the turn's pseudo-open-loop slopes from parabolas in
time.
"""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.identification.recording import LoopFrames, LoopSystem
from faintspot.loop.control.identification.slope_noise import SlopeNoise, noise_of_slopes
from faintspot.loop.control.reconstructor import make_reconstructor

FEWEST_SCORED = 5
"""Frames of a turn after settling, of which a residual phase is computed."""
_FEWEST_MEASURED = 0.5  # of a frame's slopes, for the frame to count


@dataclass(frozen=True, eq=False, repr=False)
class AlternatingLoop(LoopSystem, LoopFrames):
    """Frames of float32 of a loop with n sub-apertures, whose methods took turns; numbers may begin anew."""

    _: KW_ONLY
    time_s: Floats
    """(frames,): times at which their last rows arrived."""
    method: NDArray[np.int64]
    """(frames,): number of the method; negative where the loop was open."""
    conditions: NDArray[np.int64]
    """(frames,): number of the conditions, such as settings that all methods share."""

    @cached_property
    def phase(self) -> Floats:
        """(commands, 2 n): from slopes [px] to amplitudes [m] whose squares add up to the variance."""
        matrix, site = self.interaction_matrix, self.site
        per_px = site.pixel_scale_rad * site.subaperture_m
        return per_px * residual_phase(make_reconstructor(matrix).clean, matrix, self.cells)

    @property
    def delay(self) -> int:
        """Whole frames."""
        return int(self.delay_frames or 0)

    def mirror(self, rows: NDArray[np.int64]) -> Floats:
        """Return the slopes of the mirror in some frames, NaN where its commands were not recorded."""
        sent = rows - self.delay
        held = self.commands[np.maximum(sent, 0)].astype(np.float64) @ self.interaction_matrix.T
        known = (sent >= 0) & (self.frame[rows] - self.frame[np.maximum(sent, 0)] == self.delay)
        return np.where(known[:, None], held, np.nan)


@dataclass(frozen=True)
class Turn:
    """Consecutive frames that one method measured in a closed loop."""

    method: int
    conditions: int
    begin: int
    """First row of the recording."""
    scored: int
    """First row after settling."""
    end: int
    """Row after the last."""


@dataclass(frozen=True)
class TurnPhase:
    """Residual phase of a turn."""

    variance_m2: float
    """Variance of the residual wavefront within the mirror's reach, without noise."""
    error_m2: float
    """Standard error due to the noise of the slopes alone."""


def turns_of(loop: AlternatingLoop, settle_frames: Sequence[int]) -> list[Turn]:
    """Return the turns of which enough frames are left after settling.

    A turn ends with a change of method or conditions, when the loop opens, or where frame numbers begin anew.
    The first `settle_frames[method]` frames are not scored, counted by frame number. Turns cut short, with
    less than half of the method's usual number of scored frames, are left out.
    """
    changes = (np.diff(loop.method) != 0) | (np.diff(loop.conditions) != 0) | (np.diff(loop.frame) <= 0)
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(loop.frame)]])
    turns = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        method = int(loop.method[begin])
        if method < 0:
            continue
        settled = loop.frame[begin:end] >= loop.frame[begin] + settle_frames[method]
        turns.append(
            Turn(method, int(loop.conditions[begin]), begin, end - int(np.count_nonzero(settled)), end)
        )
    usual = [
        np.median([turn.end - turn.scored for turn in turns if turn.method == method] or [0])
        for method in range(len(settle_frames))
    ]
    return [
        turn
        for turn in turns
        if turn.end - turn.scored >= max(FEWEST_SCORED, 0.5 * float(usual[turn.method]))
    ]


def phase_of_turn(loop: AlternatingLoop, turn: Turn, gain: float) -> TurnPhase | None:
    """Return the residual phase of a turn's scored frames; None if too few are known.

    Parameters
    ----------
    gain : float
        Centroid gain of the turn's method.
    """
    rows = np.arange(turn.begin, turn.end)
    residual = loop.slopes[rows].astype(np.float64) / gain
    variance, error, shared_error = _noise(residual - loop.mirror(rows), loop.frame[rows])
    scored = residual[turn.scored - turn.begin :]
    share = np.isfinite(scored).mean(axis=1)
    usable = share >= _FEWEST_MEASURED
    if np.count_nonzero(usable) < FEWEST_SCORED or not np.isfinite(error).any():
        return None
    phase = np.nan_to_num(scored[usable]) @ loop.phase.T
    frames = len(phase)
    mean = float((np.square(phase).sum(axis=1) / share[usable]).mean())
    weight = np.square(loop.phase).sum(axis=0)
    noise = loop.phase * np.maximum(variance, 0.0) @ loop.phase.T
    squared = float(np.square(noise).sum())
    residual_m2 = mean - float(weight @ variance)
    of_frames = 2 * squared + 4 * max(residual_m2, 0.0) * squared / max(float(np.trace(noise)), 1e-300)
    of_noise = float(np.square(weight * variance) @ np.square(np.nan_to_num(error)))
    of_noise += (float(np.nan_to_num(shared_error)) * float(weight @ variance)) ** 2
    return TurnPhase(residual_m2, math.sqrt(of_frames / frames + of_noise))


def open_loop_slopes(
    loop: AlternatingLoop, turns: Sequence[Turn], gains: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return pseudo-open-loop slopes, residual slopes and numbers of runs of consecutive frames.

    All frames of the turns whose commands are known count, settling ones included; slopes that were not
    measured are 0 about their mean.
    """
    atmosphere, residual, run = [], [], []
    for number, turn in enumerate(turns):
        rows = np.arange(turn.begin, turn.end)
        slopes = loop.slopes[rows].astype(np.float64) / gains[turn.method]
        open_loop = slopes - loop.mirror(rows)
        known = np.isfinite(open_loop).any(axis=1)
        atmosphere.append(open_loop[known])
        residual.append(slopes[known])
        run.append(number * len(loop.frame) + loop.frame[rows[known]] - np.arange(np.count_nonzero(known)))
    centred = []
    for parts in (atmosphere, residual):
        values = np.concatenate(parts)
        centred.append(np.nan_to_num(values - np.nanmean(values, axis=0)))
    return centred[0], centred[1], np.concatenate(run)


def _noise(open_loop: Floats, frame: NDArray[np.int64]) -> SlopeNoise:
    """Return the noise of the slopes in a turn."""
    grid = np.full((int(frame[-1] - frame[0]) + 1, open_loop.shape[1]), np.nan)
    grid[frame - frame[0]] = open_loop
    return noise_of_slopes(grid)


_FRAMES_BEFORE = 2
_MOST_TURNS = 1500  # of each kind of change
_FEWEST_CHANGES = 12
_SPECKLE_ERROR = 0.1  # relative: of gains of methods that see spots differently


@dataclass(frozen=True, eq=False)
class RelativeGains:
    """Centroid gains of methods relative to a reference."""

    gain: Floats
    """(methods,): 1 for the reference."""
    error: Floats
    """(methods,): standard errors; 0 for the reference and methods that share its gain, infinite where a gain
    of 1 is assumed."""


def relative_gains(
    loop: AlternatingLoop, turns: Sequence[Turn], groups: Sequence[int], reference: int
) -> RelativeGains:
    """Return the centroid gains of methods relative to that of the reference.

    Parameters
    ----------
    loop : AlternatingLoop
    turns : sequence of Turn
        In the order of time.
    groups : sequence of int
        For each method a number that methods with the same gain share, such as those that differ in the
        controller only.
    reference : int
        Method whose gain is 1.
    """
    numbers = np.unique(groups, return_inverse=True)[1]
    changes: dict[tuple[int, int], list[tuple[Turn, Turn]]] = {}
    for before, after in pairwise(turns):
        pair = int(numbers[before.method]), int(numbers[after.method])
        if pair[0] != pair[1] and _follows(loop, before, after):
            changes.setdefault(pair, []).append((before, after))
    ratios = {
        pair: ratio
        for pair, found in changes.items()
        if len(found) >= _FEWEST_CHANGES and (ratio := _ratio(loop, found)) is not None
    }
    gain, error = _connected(ratios, int(numbers.max()) + 1, int(numbers[reference]))
    return RelativeGains(gain[numbers], error[numbers])


def _follows(loop: AlternatingLoop, before: Turn, after: Turn) -> bool:
    """Return whether a turn directly follows another one, without a lost frame near the change."""
    first = after.begin - _FRAMES_BEFORE - loop.delay
    return (
        before.end == after.begin
        and before.conditions == after.conditions
        and first >= before.scored
        and int(loop.frame[after.begin] - loop.frame[first]) == after.begin - first
    )


def _ratio(loop: AlternatingLoop, changes: list[tuple[Turn, Turn]]) -> tuple[float, float] | None:
    """Return the ratio of the gain after the change to that before it, and its standard error."""
    changes = changes[:: math.ceil(len(changes) / _MOST_TURNS)]
    steady = [_features(loop, np.arange(before.scored + _FRAMES_BEFORE, before.end)) for before, _ in changes]
    target, features = (np.concatenate(parts) for parts in zip(*steady, strict=True))
    at_change = _features(loop, np.array([after.begin for _, after in changes]))
    known = np.isfinite(features).all(axis=(1, 2)) & np.isfinite(target).all(axis=1)
    known_at_change = np.isfinite(at_change[1]).all(axis=(1, 2)) & np.isfinite(at_change[0]).all(axis=1)
    if np.count_nonzero(known_at_change) < _FEWEST_CHANGES or np.count_nonzero(known) < target.shape[1]:
        return None
    target, features = target[known], features[known]
    changed, features_at_change = (values[known_at_change] for values in at_change)
    means = features.mean(axis=0)
    modes = np.linalg.svd(target - target.mean(axis=0), full_matrices=False)[2].T
    predicted, deviation = _prediction((features - means), (target - target.mean(axis=0)) @ modes, modes)
    expected = np.einsum("kif,if->ki", np.einsum("ksf,si->kif", features_at_change - means, modes), predicted)
    measured = (changed - changed.mean(axis=0)) @ modes
    expected = expected - expected.mean(axis=0)
    products = (measured * expected / deviation).sum(axis=1)
    squares = (expected * expected / deviation).sum(axis=1)
    ratio = float(products.sum() / squares.sum())
    without = (products.sum() - products) / (squares.sum() - squares)
    count = len(products)
    error = math.sqrt((count - 1) / count * float(np.square(without - without.mean()).sum()))
    return (ratio, error) if ratio > 0 and math.isfinite(error) and error > 0 else None


def _features(loop: AlternatingLoop, rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return slopes (frames, 2 n), and what predicts each (frames, 2 n, features): slopes and mirror before.

    Slopes that were not measured are 0; NaN where the mirror is not known.
    """
    slopes = np.nan_to_num(loop.slopes[rows].astype(np.float64))
    before = [
        np.nan_to_num(loop.slopes[rows - lag].astype(np.float64)) for lag in range(1, _FRAMES_BEFORE + 1)
    ]
    mirror = [loop.mirror(rows - lag) for lag in range(_FRAMES_BEFORE + 1)]
    return slopes, np.stack([*before, *mirror], axis=-1)


def _prediction(features: Floats, target: Floats, modes: Floats) -> tuple[Floats, Floats]:
    """Return coefficients (modes, features) that predict each mode, and the variance of the deviations."""
    coefficients, deviation = [], []
    for mode, values in zip(modes.T, target.T, strict=True):
        known = np.einsum("ksf,s->kf", features, mode)
        solution = np.linalg.lstsq(known, values, rcond=None)[0]
        coefficients.append(solution)
        deviation.append(float(np.var(values - known @ solution)))
    return np.array(coefficients), np.maximum(deviation, 1e-12 * max(deviation))


def _connected(
    ratios: dict[tuple[int, int], tuple[float, float]], count: int, reference: int
) -> tuple[Floats, Floats]:
    """Return gains and standard errors that fit all ratios best; contradicting ratios have larger errors."""
    gain, error = np.ones(count), np.full(count, math.inf)
    error[reference] = 0.0
    others = _reached(ratios, reference)
    if not others:
        return gain, error
    rows, values, weights = [], [], []
    for (before, after), (ratio, ratio_error) in ratios.items():
        if {before, after} <= {reference, *others}:
            rows.append([float(number == after) - float(number == before) for number in others])
            values.append(math.log(ratio))
            weights.append((ratio / ratio_error) ** 2)
    design, logarithm, weight = np.array(rows), np.array(values), np.array(weights)
    covariance = np.linalg.inv(design.T @ (weight[:, None] * design))
    solution = covariance @ design.T @ (weight * logarithm)
    free = len(values) - len(others)
    misfit = float(weight @ np.square(logarithm - design @ solution))
    scale = math.sqrt(max(1.0, misfit / free)) if free else 1.0
    gain[others] = np.exp(solution)
    error[others] = gain[others] * np.hypot(scale * np.sqrt(np.diag(covariance)), _SPECKLE_ERROR)
    return gain, error


def _reached(ratios: dict[tuple[int, int], tuple[float, float]], reference: int) -> list[int]:
    """Return the numbers that ratios connect with the reference, itself excluded."""
    reached = {reference}
    for _ in range(len(ratios)):
        reached |= {number for pair in ratios if reached & set(pair) for number in pair}
    return sorted(reached - {reference})
