"""Differences of Strehl ratios as magnitudes of the guide star."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.foreign.evaluation import FILTER, Runs
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.reconstructor import make_reconstructor

_STEPS = (0.5, 1.0, 1.5, 2.0)


def in_magnitudes(
    scores: dict[str, list[float]],
    brighter: Callable[[float], Runs],
    plain: str,
    start_gain: float,
    log: Callable[[str], None],
) -> dict[str, Any]:
    """Return by how many magnitudes the filter is ahead of each control.

    Both Strehl ratios are placed on the curve of the integrator, tuned at every flux, for each turbulence. A
    Strehl ratio beyond the brightest star gives a lower limit, without an error.

    Parameters
    ----------
    scores : dict
        Strehl ratios of the controls in each turbulence.
    brighter : callable
        Takes a factor on the flux, and returns the runs of that loop.
    plain : str
        Name of the integrator.
    start_gain : float
        Gain from which the search for the best one starts.
    """
    curve, steps = [scores[plain]], [0.0]
    for step in _STEPS:
        runs = brighter(10 ** (0.4 * step))
        matrix = make_reconstructor(runs.loop.interaction).matrix
        start_gain, _ = runs.best_gain(plain, matrix, start_gain)
        frames = runs.effort.frames
        curve.append([runs.integrator(plain, matrix, start_gain, s, frames).score for s in runs.effort.seeds])
        steps.append(step)
        log(f"{step:g} magnitudes brighter, gain {start_gain:g}: {curve[-1]}")
        if (np.array(curve[-1]) >= scores[FILTER]).all():
            break
    ahead = {}
    ours, is_beyond = _placed(scores[FILTER], np.array(curve), np.array(steps))
    for name, values in scores.items():
        if name != FILTER:
            theirs, _ = _placed(values, np.array(curve), np.array(steps))
            difference = paired_mean(ours - theirs)
            ahead[name] = [difference.value, float("nan") if is_beyond else difference.standard_error]
    return {"ahead": ahead, "steps": steps, "curve": curve, "is_lower_limit": is_beyond}


def _placed(values: list[float], curve: Any, steps: Any) -> tuple[Any, bool]:
    """Return the magnitudes at which each turbulence's curve has a Strehl ratio, and whether any is beyond.

    Below the faintest star the first part of the curve is continued.
    """
    places = []
    for value, column in zip(values, np.maximum.accumulate(curve).T, strict=True):
        place = float(np.interp(value, column, steps))
        if value < column[0]:
            place = steps[1] * (value - column[0]) / max(column[1] - column[0], 1e-3)
        places.append(place)
    return np.array(places), bool((np.array(values) > curve.max(axis=0)).any())
