"""Places where falling curves cross a level."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_SAME = 1e-9  # difference of a level from the end of a curve that rounding makes
_HALVINGS = 50  # of the interval in which a curve crosses the level


def crossings(places: Floats, curves: Floats, level: ArrayLike, *, straight: bool = False) -> Floats:
    """Return where falling curves reach a level, (...).

    Infinite when a curve stays above within the places, minus infinite when it is never above.

    Parameters
    ----------
    places : (n,) array
        Rising.
    curves : (..., n) array
        Values there, which never rise.
    level : (...) array
        One for all curves, or one for each.
    straight : bool
        Whether points are joined by straight lines. Default: by the monotone cubic of Fritsch & Butland 1984,
        SIAM J. Sci. Stat. Comput. 5, 300.
    """
    from scipy.interpolate import PchipInterpolator

    wanted = np.broadcast_to(level, curves.shape[:-1])
    for end in (curves[..., 0], curves[..., -1]):
        wanted = np.where(np.abs(wanted - end) < _SAME, end, wanted)
    after = np.maximum(np.argmax(curves <= wanted[..., None], axis=-1), 1)[..., None]

    def at_both(values: Floats) -> tuple[Floats, Floats]:
        values = np.broadcast_to(values, curves.shape)
        ends = (np.take_along_axis(values, index, -1)[..., 0] for index in (after - 1, after))
        return next(ends), next(ends)

    (first, last), (high, low) = at_both(places), at_both(curves)
    part = (high - wanted) / np.where(high > low, high - low, 1.0)
    if not straight:
        slopes = at_both(PchipInterpolator(places, curves, axis=-1).derivative()(places))
        part = _crossing((high, low), ((last - first) * slopes[0], (last - first) * slopes[1]), wanted)
    bounded = np.where(curves[..., -1] > wanted, np.inf, first + part * (last - first))
    return np.asarray(np.where(curves[..., 0] < wanted, -np.inf, bounded), np.float64)


def _crossing(values: tuple[Floats, Floats], slopes: tuple[Floats, Floats], level: Floats) -> Floats:
    """Return where in [0, 1] falling cubics cross a level, from their values and slopes at both ends."""
    (high, low), (slope, next_slope) = values, slopes
    start, end = np.zeros_like(high), np.ones_like(high)
    for _ in range(_HALVINGS):
        t = 0.5 * (start + end)
        rest = 1.0 - t
        value = rest**2 * ((1 + 2 * t) * high + t * slope) + t**2 * ((3 - 2 * t) * low - rest * next_slope)
        start, end = np.where(value >= level, t, start), np.where(value >= level, end, t)
    return 0.5 * (start + end)
