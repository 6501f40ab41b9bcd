"""Flags of spots that are probably wrong: cut by the window edge, or unlike all their neighbours."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.flags import UNMEASURED, SubapertureFlag
from faintspot.slopes.kernels.compilation.compiling import compiled

_UNMEASURED = int(UNMEASURED)
UNLIKE_NEIGHBOURS = int(SubapertureFlag.UNLIKE_NEIGHBOURS)
AT_SEARCH_LIMIT = int(SubapertureFlag.AT_SEARCH_LIMIT)

TYPICAL = 4.5
"""Times the median over the sub-apertures that a spot is off what its neighbours say: by chance, of normally
distributed displacements, 1 in 1000 of 7 x 7 sub-apertures, 1 in 2000 of 40 x 40."""


class Expected(NamedTuple):
    """Expected positions of the spots."""

    zero: Any
    """(2, n) float32: reference positions x and y, px from the windows' middles."""
    edge: Any
    """(2, n) float32: how far from its window's middle a spot is whole, px; infinite where not checked."""
    lines: Any
    """(n, m, 2) int64: two sub-apertures in line with each, n where there is none; see `outside`."""
    outside: Any
    """(n, m) bool: whether both are on the same side, the nearer one first, rather than opposite."""
    least: Any
    """Smaller differences from a line never count, px."""


@compiled
def flag_doubtful(x: Any, y: Any, flags: Any, expected: Any, differences: Any) -> None:
    """Add AT_SEARCH_LIMIT and UNLIKE_NEIGHBOURS to the flags of measured slopes, each (n_frames, n).

    Displacements that change evenly from one neighbour to the next are alike. `differences` is scratch, (n,)
    float32.
    """
    zero, edge = expected.zero, expected.edge
    for f in range(x.shape[0]):
        largest = np.float32(0.0)
        for s in range(x.shape[1]):
            differences[s] = -1.0
            if flags[f, s] & _UNMEASURED:
                continue
            if abs(x[f, s] + zero[0, s]) > edge[0, s] or abs(y[f, s] + zero[1, s]) > edge[1, s]:
                flags[f, s] |= AT_SEARCH_LIMIT
            differences[s], least = _difference(f, s, x, y, flags, expected)
            largest = max(largest, least)
        if largest > expected.least:
            limit = TYPICAL * _median(differences)
            for s in range(x.shape[1]):
                if differences[s] > limit and _difference(f, s, x, y, flags, expected)[1] > expected.least:
                    flags[f, s] |= UNLIKE_NEIGHBOURS


@compiled
def _median(values: Any) -> Any:
    """Return the median of the non-negative values, by bisection to 2^-16 of the largest."""
    least, most = np.float32(0.0), np.float32(0.0)
    for s in range(values.shape[0]):
        most = max(most, values[s])
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
def _difference(f: Any, s: Any, x: Any, y: Any, flags: Any, expected: Any) -> Any:
    """Return how much a slope differs from the most similar of its lines, for comparison and in px.

    For comparison, it is divided by its error for slopes of error 1; -1 without a line.
    """
    lines, n = expected.lines, x.shape[1]
    square = least = np.float32(math.inf)
    for k in range(lines.shape[1]):
        a, b = lines[s, k, 0], lines[s, k, 1]
        if a == n:
            break
        if (flags[f, a] | flags[f, b]) & _UNMEASURED:
            continue
        near, far, variance = np.float32(0.5), np.float32(0.5), np.float32(1.5)
        if expected.outside[s, k]:
            near, far, variance = np.float32(2.0), np.float32(-1.0), np.float32(6.0)
        away_x = x[f, s] - near * x[f, a] - far * x[f, b]
        away_y = y[f, s] - near * y[f, a] - far * y[f, b]
        away = away_x * away_x + away_y * away_y
        square, least = min(square, away / variance), min(least, away)
    if square == math.inf:
        return np.float32(-1.0), np.float32(0.0)
    return np.float32(math.sqrt(square)), np.float32(math.sqrt(least))
