"""Differences of Strehl ratios as magnitudes of the guide star."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from benchmarks.loops.foreign.evaluation import Runs
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.telemetry.choices import FILTER

Floats = NDArray[np.float64]

_STEPS = 1.0, 2.0


def in_magnitudes(
    scores: dict[str, list[float]],
    brighter: Callable[[float], Runs],
    plain: str,
    start_gain: float,
    log: Callable[[str], None],
) -> dict[str, Any]:
    """Return by how many magnitudes the filter is ahead of each control.

    Both Strehl ratios are placed on the curve of the integrator, tuned at every flux, for each turbulence. A
    Strehl ratio beyond the brightest star gives a lower limit, without an error; so does one of another
    control below the integrator's.

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
    ours, is_beyond = _placed(scores[FILTER], np.array(curve), steps)
    for name, values in scores.items():
        if name != FILTER:
            theirs, _ = _placed(values, np.array(curve), steps)
            difference = paired_mean(ours - theirs)
            is_limit = is_beyond or np.mean(values) < np.mean(scores[plain])
            ahead[name] = [difference.value, float("nan") if is_limit else difference.standard_error]
    return {"ahead": ahead, "steps": steps, "curve": curve}


def _placed(values: list[float], curve: Floats, steps: list[float]) -> tuple[Floats, bool]:
    """Return the magnitudes at which each turbulence's curve has a Strehl ratio, and whether any is beyond.

    At or below the faintest star they are 0.
    """
    fine = np.linspace(0.0, steps[-1], 401)
    columns = [PchipInterpolator(steps, column)(fine) for column in np.maximum.accumulate(curve).T]
    places = [
        fine[min(int(np.searchsorted(column, value)), len(fine) - 1)]
        for value, column in zip(values, columns, strict=True)
    ]
    is_beyond = any(value > column[-1] for value, column in zip(values, columns, strict=True))
    return np.array(places), is_beyond
