"""Answers for closed loops that are made up, so that their statistics are known."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from faintspot.experiments.closed_loop.answer import LoopAnswer
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, NOISE_SCALE, MethodKind, Tunable, method_kind
from faintspot.experiments.closed_loop.question import LoopQuestion
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration, load_loop

PHOTONS = (5.0, 14.0, 40.0, 100.0, 320.0)
BRIGHT = 0.8
SHIFTS = {"brightest": -2.0, "window": 0.0, "smoothed": 0.01, "map_predicted": 0.2, "window+kalman": 0.5}
"""Magnitudes by which the curves are fainter than the baseline's."""
MIDDLE = 13.0
"""Magnitude at which the baseline has half of what it has with bright stars."""
_VALUES = {LOOP_GAIN: 0.4, NOISE_SCALE: 0.6, "keep_brightest": 12, "window_fwhm_px": 3.0, "prior_std_px": 0.5}


def configuration() -> LoopConfiguration:
    """Near the diffraction limit, 100 photons."""
    return load_loop("diffraction_limit")


def strehl_of(magnitudes: Any, shift: float) -> Any:
    """A curve that falls around MIDDLE + shift."""
    return BRIGHT / (1 + np.exp(2.0 * (np.asarray(magnitudes) - MIDDLE - shift)))


def made_up(
    shifts: Mapping[str, float] = SHIFTS, realisations: int = 4, scatter: float = 1e-3, **asked: Any
) -> LoopAnswer:
    """Curves of one shape on air that is the same for all, with a scatter of their own."""
    question = LoopQuestion(configuration(), methods=tuple(shifts), **asked)
    rng = np.random.default_rng(5)
    magnitudes = question.configuration.photometry.magnitude(PHOTONS)
    atmosphere = rng.normal(0.0, 0.02, (len(PHOTONS), realisations))
    kinds = [method_kind(name) for name in shifts]
    strehl = np.array(
        [
            strehl_of(magnitudes, shift)[:, None] + atmosphere + rng.normal(0.0, scatter, atmosphere.shape)
            for shift in shifts.values()
        ]
    )
    shape = strehl.shape[:2]
    choices = [
        json.dumps({name: _value(kind, name, each) for name, each in kind.tuned(configuration()).items()})
        for kind in kinds
    ]
    measured = MagnitudeResult(
        tuple(kind.name for kind in kinds),
        tuple(kind.label for kind in kinds),
        np.array(PHOTONS),
        magnitudes,
        np.maximum(strehl, 0.0),
        np.full(strehl.shape, 0.9),
        np.full(shape, ""),
        np.repeat(np.array(choices)[:, None], shape[1], axis=1),
        configuration().to_text(),
    )
    return LoopAnswer(question, measured, 300, {"map+kalman": "no time"})


def _value(kind: MethodKind, name: str, tunable: Tunable) -> Any:
    """Return a value that is not the last on offer, but for the window's width."""
    if (kind.name, name) == ("window", "window_fwhm_px"):
        return tunable.values[-1]
    return _VALUES.get(name, tunable.first[0])
