"""Choosing options on one sample, so that they can be scored on another."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.compare.statistics import slope_statistics

_ROUNDS = 2  # of looking along each axis in turn

Choice = dict[str, Any]
"""A value for each option."""
Axes = Mapping[str, Sequence[Any]]
"""What each option may be; the usual value is the first."""


def coordinate_search(axes: Axes, badness: Callable[[Choice, str, Sequence[Any]], Sequence[float]]) -> Choice:
    """Look along each axis in turn, from the first values, and again along those for which others changed.

    Parameters
    ----------
    axes : mapping
    badness : callable
        Called with a choice, the name of an option and values of it; returns how bad the choice is with each
        of them.

    Returns
    -------
    dict
        The choice where the search ends.
    """
    best: Choice = {name: values[0] for name, values in axes.items()}
    looked: dict[str, Choice] = {}
    for name in list(axes) * (_ROUNDS if len(axes) > 1 else 1):
        others = {key: value for key, value in best.items() if key != name}
        if looked.get(name) != others:  # else nothing has changed since
            looked[name] = others
            best = {**best, name: axes[name][int(np.argmin(badness(best, name, axes[name])))]}
    return best


def corrected_badness(x: ArrayLike, y: ArrayLike, truth: ArrayLike) -> float:
    """Return the gain-corrected rms; where nothing is measured, the rms, behind all that measure."""
    found = slope_statistics(x, y, truth)
    corrected = found.corrected_rms.value
    return corrected if math.isfinite(corrected) else 1e6 + found.rms.value


__all__ = ["Axes", "Choice", "coordinate_search", "corrected_badness"]
