"""Centroid gains of alternating methods relative to one of them, from the frames at which they change.

In the first frame of a turn the mirror still has commands from the method before. The true residual slopes
are those that this method would have measured, up to the ratio of the two gains. So the ratio is that of the
slopes to their linear prediction from the frames before, which is fitted where the method did not change.
White noise of the new frame is not correlated with the prediction. Nothing is assumed of the turbulence.

Speckled spots move by more than the mean gradient of the wavefront, as each method sees it. In simulated
loops of 7 x 7 sub-apertures the ratios were 0.04 to 0.15 above those of the true gradients, which is part of
the error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.telemetry.alternation import AlternatingLoop, Turn

Floats = NDArray[np.float64]

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
    first = after.begin - _FRAMES_BEFORE - loop.delay_frames
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
    slopes = np.nan_to_num(loop.slopes_px[rows].astype(np.float64))
    before = [
        np.nan_to_num(loop.slopes_px[rows - lag].astype(np.float64)) for lag in range(1, _FRAMES_BEFORE + 1)
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
