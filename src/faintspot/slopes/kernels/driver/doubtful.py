"""Flags of spots that are probably wrong: cut by the window edge, or unlike all their neighbours."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.flags import INVALID, SubapertureFlag
from faintspot.slopes.kernels.compilation.compiling import compiled

_INVALID = int(INVALID)
UNLIKE_NEIGHBOURS = int(SubapertureFlag.UNLIKE_NEIGHBOURS)
AT_SEARCH_LIMIT = int(SubapertureFlag.AT_SEARCH_LIMIT)

FEWEST_NEIGHBOURS = 2
TYPICAL = 5.0
"""Times the median over the sub-apertures that a spot differs from the neighbour it is most like: where
neighbours move independently, about 1 spot in 1000 differs by as much."""


class Expected(NamedTuple):
    """Expected positions of the spots."""

    zero: Any
    """(2, n) float32: reference positions x and y, px from the windows' middles."""
    edge: Any
    """(2, n) float32: how far from its window's middle a spot is whole, px; infinite where not checked."""
    neighbours: Any
    """(n, m) int64: numbers of the neighbouring sub-apertures, n where there is none."""
    least: Any
    """Smaller differences from a neighbour never count, px."""


@compiled
def flag_doubtful(x: Any, y: Any, flags: Any, expected: Any, differences: Any) -> None:
    """Add AT_SEARCH_LIMIT and UNLIKE_NEIGHBOURS to the flags of valid slopes, each (n_frames, n).

    `differences` is scratch, (n,) float32.
    """
    zero, edge, neighbours = expected.zero, expected.edge, expected.neighbours
    for f in range(x.shape[0]):
        largest = np.float32(0.0)
        for s in range(x.shape[1]):
            differences[s] = -1.0
            if flags[f, s] & _INVALID:
                continue
            if abs(x[f, s] + zero[0, s]) > edge[0, s] or abs(y[f, s] + zero[1, s]) > edge[1, s]:
                flags[f, s] |= AT_SEARCH_LIMIT
            differences[s] = _least_difference(f, s, x, y, flags, neighbours)
            largest = max(largest, differences[s])
        if largest > expected.least:
            limit = max(expected.least, TYPICAL * _median(differences, largest))
            for s in range(x.shape[1]):
                if differences[s] > limit:
                    flags[f, s] |= UNLIKE_NEIGHBOURS


@compiled
def _median(values: Any, largest: Any) -> Any:
    """Return the median of the non-negative values, by bisection to 2^-16 of the largest."""
    least, most = np.float32(0.0), largest
    for _ in range(16):
        middle = np.float32(0.5) * (least + most)
        above = below = 0
        for s in range(values.shape[0]):
            above += values[s] > middle
            below += (values[s] >= 0.0) & (values[s] <= middle)
        if above > below:
            least = middle
        else:
            most = middle
    return most


@compiled
def _least_difference(f: Any, s: Any, x: Any, y: Any, flags: Any, neighbours: Any) -> Any:
    """Return the distance of a slope from its most similar neighbour; -1 with too few valid neighbours."""
    square, count = np.float32(math.inf), 0
    for k in range(neighbours.shape[1]):
        other = neighbours[s, k]
        if other < x.shape[1] and flags[f, other] & _INVALID == 0:
            away_x, away_y = x[f, s] - x[f, other], y[f, s] - y[f, other]
            square = min(square, away_x * away_x + away_y * away_y)
            count += 1
    return np.float32(math.sqrt(square)) if count >= FEWEST_NEIGHBOURS else np.float32(-1.0)
