"""Flags of spots that are probably wrong: cut by the window edge, or unlike all their neighbours."""

import math
from typing import NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.flags import INVALID, UNMEASURED, SubapertureFlag
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.gather import Frames
from faintspot.slopes.kernels.groups import SlopeArrays
from faintspot.slopes.kernels.host import WIDTHS
from faintspot.slopes.kernels.simd import (
    Lanes,
    Pair,
    Vector,
    any_lane,
    gathered,
    load,
    minimum,
    select,
    splat,
    square_root,
    store,
    width_of,
)
from faintspot.slopes.kernels.validity.dark import LightTest, flag_dark

_UNMEASURED, _INVALID = int(UNMEASURED), int(INVALID)
UNLIKE_NEIGHBOURS = int(SubapertureFlag.UNLIKE_NEIGHBOURS)
AT_SEARCH_LIMIT = int(SubapertureFlag.AT_SEARCH_LIMIT)
SATURATED = int(SubapertureFlag.SATURATED)

TYPICAL = 4.5
"""Times the median over the sub-apertures that a spot is off what its neighbours say: by chance, of normally
distributed displacements, 1 in 1000 of 7 x 7 sub-apertures, 1 in 2000 of 40 x 40."""

SUSPECT, LIKE = 1.5, 2.0
"""Likewise where the flux shows a second spot or a ghost; and for one that lines of valid ones confirm."""
_SECOND_SPOT, _GHOST = 1.25, 0.25
"""Flux over that of the brightest neighbour, from which a window holds a second spot; and over that of the
dimmest one, up to which it holds the ghost of another spot."""
_SURELY = 4.0
"""Photon noise by which the difference from these limits (for a second spot, from no excess) is not zero."""


class Expected(NamedTuple):
    """Expected positions of the spots."""

    lanes: Lanes
    """Lanes: W sub-apertures at once."""
    zero: Array
    """(2, n) float32: reference positions x and y, px from the windows' middles."""
    edge: Array
    """(2, n) float32: how far from its window's middle a spot is whole, px; infinite where not checked."""
    lines: Array
    """(m, 2, p) int32: two sub-apertures in line with each, n where there is none; see `lines_of`."""
    far: Array
    """(m, p) float32: weight of the second one; NaN where there is none."""
    behind: Array
    """(n, m, 2) int64: a neighbour of each and the one behind it, n where there is none; m may be 0."""
    least: np.float32
    """Smaller differences from a line never count, px."""


def doubtful_scratch_size(n: int) -> int:
    """Return the number of float32 numbers that `flag_doubtful` needs."""
    return 4 * (n + 2 * max(WIDTHS))


@compiled
def check_slopes(
    test: LightTest, frames: Frames, slopes: SlopeArrays, expected: Expected, scratch: Array
) -> None:
    """Flag dark sub-apertures and doubtful spots of frames; see `flag_dark` and `flag_doubtful`."""
    flag_dark(test, frames, slopes, scratch)
    flag_doubtful(slopes.x, slopes.y, slopes.flux, slopes.flags, expected, scratch)


@compiled
def flag_doubtful(x: Array, y: Array, flux: Array, flags: Array, expected: Expected, scratch: Array) -> None:
    """Add AT_SEARCH_LIMIT and UNLIKE_NEIGHBOURS to the flags of measured slopes, each (n_frames, n).

    Displacements that change evenly from one neighbour to the next are alike. `scratch` has at least
    `doubtful_scratch_size` numbers of float32.
    """
    zero, edge, n, padded = expected.zero, expected.edge, x.shape[1], expected.far.shape[1]
    at_x, at_y, rest = scratch[: padded + 1], scratch[padded + 1 : 2 * padded + 2], scratch[2 * padded + 2 :]
    for f in range(x.shape[0]):
        for s in range(n):
            cut = (abs(x[f, s] + zero[0, s]) > edge[0, s]) | (abs(y[f, s] + zero[1, s]) > edge[1, s])
            unmeasured = (flags[f, s] & np.uint8(_UNMEASURED)) != 0
            flags[f, s] |= np.uint8(AT_SEARCH_LIMIT) if cut & (not unmeasured) else np.uint8(0)
        for s in range(n):
            unmeasured = (flags[f, s] & np.uint8(_UNMEASURED)) != 0
            at_x[s] = np.float32(math.nan) if unmeasured else x[f, s]
            at_y[s] = np.float32(math.nan) if unmeasured else y[f, s]
        for s in range(n, padded + 1):
            at_x[s] = at_y[s] = math.nan
        if _is_any_suspect((at_x, at_y), expected):  # only then all lines of all spots are needed
            _compare(f, x, y, flux, flags, expected, (at_x, at_y), rest)


@compiled
def _away(lanes: Lanes, first: int, at: tuple[Array, Array], expected: Expected, enough: Vector) -> Pair:
    """Return the squared differences of W slopes from the most similar of their lines; infinite without one.

    The first ones are divided by their variance for slopes of error 1, the second ones are in px^2. Lines are
    looked at until no second one is `enough` or more.
    """
    one, (at_x, at_y) = splat(lanes, 1.0), at
    here_x, here_y = load(lanes, at_x, first), load(lanes, at_y, first)
    square = least = splat(lanes, math.inf)
    for k in range(expected.far.shape[0]):
        place = 2 * k * expected.far.shape[1] + first
        behind = place + expected.far.shape[1]
        far = load(lanes, expected.far, k * expected.far.shape[1] + first)
        if not any_lane(far <= one):
            break
        near = one - far
        away_x = here_x - near * gathered(lanes, at_x, expected.lines, place)
        away_y = here_y - near * gathered(lanes, at_y, expected.lines, place)
        away_x = away_x - far * gathered(lanes, at_x, expected.lines, behind)
        away_y = away_y - far * gathered(lanes, at_y, expected.lines, behind)
        away = away_x * away_x + away_y * away_y
        square = minimum(away / (one + near * near + far * far), square)
        least = minimum(away, least)
        if not any_lane(least >= enough):
            break
    return square, least


@compiled
def _is_any_suspect(at: tuple[Array, Array], expected: Expected) -> bool:
    """Return whether a slope may differ from each of its lines by more than the difference that counts."""
    lanes, width = expected.lanes, width_of(expected.lanes)
    like = splat(lanes, np.float32(0.99) * expected.least * expected.least)
    infinite, zero = splat(lanes, math.inf), splat(lanes, 0.0)
    for first in range(0, expected.far.shape[1], width):
        least = _away(lanes, first, at, expected, like)[1]
        if any_lane(select(least < infinite, least, zero) >= like):
            return True
    return False


@compiled
def _compare(
    f: int,
    x: Array,
    y: Array,
    flux: Array,
    flags: Array,
    expected: Expected,
    at: tuple[Array, Array],
    scratch: Array,
) -> None:
    """Compare the slopes of a frame with their lines, and flag those unlike all their neighbours."""
    lanes, width = expected.lanes, width_of(expected.lanes)
    n, padded, largest, other_flux = x.shape[1], expected.far.shape[1], np.float32(0.0), 0
    differences, least_px = scratch[:padded], scratch[padded : 2 * padded]
    infinite, zero, none = splat(lanes, math.inf), splat(lanes, 0.0), splat(lanes, -1.0)
    counts = splat(lanes, expected.least)
    for first in range(0, padded, width):
        square, least = _away(lanes, first, at, expected, none)
        is_one = square < infinite
        least = square_root(select(is_one, least, zero))
        store(differences, first, select(is_one, square_root(square), none))
        store(least_px, first, least)
        if any_lane(least > counts):
            for s in range(first, min(first + width, n)):
                if least_px[s] > expected.least:
                    largest = max(largest, differences[s])
                    other_flux += _has_other_flux(f, s, flux, flags, expected)
    if other_flux > 0 or _exceeds(differences, n, np.float32(1.0 / TYPICAL) * largest):
        _flag_unlike(f, x, y, flux, flags, expected, differences, least_px)


@compiled
def _flag_unlike(
    f: int,
    x: Array,
    y: Array,
    flux: Array,
    flags: Array,
    expected: Expected,
    differences: Array,
    least_px: Array,
) -> None:
    """Add UNLIKE_NEIGHBOURS to the flags of a frame; take it from spots whose neighbours were wrong."""
    n = x.shape[1]
    median = _median(differences, n)
    for s in range(n):
        if not (differences[s] > SUSPECT * median and least_px[s] > expected.least):
            continue
        if differences[s] > TYPICAL * median or _has_other_flux(f, s, flux, flags, expected):
            flags[f, s] |= UNLIKE_NEIGHBOURS
    for s in range(n):
        if not flags[f, s] & UNLIKE_NEIGHBOURS or _has_other_flux(f, s, flux, flags, expected):
            continue
        if _is_continued(f, s, x, y, flags, expected, LIKE * median):
            differences[s] = -2.0
    for s in range(n):
        if differences[s] == -2.0:
            flags[f, s] &= ~UNLIKE_NEIGHBOURS


@compiled
def _has_other_flux(f: int, s: int, flux: Array, flags: Array, expected: Expected) -> bool:
    """Return whether a window has clearly more flux than all its neighbours, or a fraction of it.

    A second spot or a ghost causes that. Windows with saturated pixels never count.
    """
    if flags[f, s] & SATURATED:
        return False
    lines, n, own = expected.lines, flux.shape[1], flux[f, s]
    brightest, dimmest = np.float32(0.0), np.float32(math.inf)
    for k in range(lines.shape[0]):
        for i in range(2):
            other = lines[k, i, s]
            if other < n and not flags[f, other] & _UNMEASURED:
                brightest, dimmest = max(brightest, flux[f, other]), min(dimmest, flux[f, other])
                if _GHOST * dimmest <= own <= _SECOND_SPOT * brightest:
                    return False
    if not brightest > 0.0:
        return False
    if own < _GHOST * dimmest:
        lack, variance = _GHOST * dimmest - own, _GHOST * _GHOST * dimmest + max(own, 0.0)
        stands_apart = dimmest - own > brightest - dimmest  # also where read noise makes fluxes differ
        return stands_apart and lack * lack > _SURELY * _SURELY * variance
    excess, both = own - brightest, own + brightest
    return excess * excess > _SURELY * _SURELY * both


@compiled
def _is_continued(f: int, s: int, x: Array, y: Array, flags: Array, expected: Expected, limit: float) -> bool:
    """Return whether a slope continues at least half of the lines of two valid ones beside it."""
    agree = total = 0
    for k in range(expected.behind.shape[1]):
        a, b = expected.behind[s, k, 0], expected.behind[s, k, 1]
        if b == x.shape[1] or (flags[f, a] | flags[f, b]) & _INVALID:
            continue
        away_x, away_y = x[f, s] - 2.0 * x[f, a] + x[f, b], y[f, s] - 2.0 * y[f, a] + y[f, b]
        away = away_x * away_x + away_y * away_y
        agree += away <= expected.least * expected.least or away <= 6.0 * limit * limit
        total += 1
    return total > 0 and 2 * agree >= total


@compiled
def _exceeds(values: Array, n: int, limit: float) -> bool:
    """Return whether a limit is at least the median of the first n values, without the negative ones."""
    above = below = 0
    for s in range(n):
        above += values[s] > limit
        below += (values[s] >= 0.0) & (values[s] <= limit)
    return limit > 0.0 and below >= above


@compiled
def _median(values: Array, n: int) -> np.float32:
    """Return the median of the first n values without the negative ones, to 2^-16 of the largest."""
    least, most = np.float32(0.0), np.float32(0.0)
    for s in range(n):
        most = max(most, values[s])
    for _ in range(16):
        middle = np.float32(0.5) * (least + most)
        above = below = 0
        for s in range(n):
            above += values[s] > middle
            below += (values[s] >= 0.0) & (values[s] <= middle)
        if above > below:
            least = middle
        else:
            most = middle
    return most
