"""Questions and answers for the tests of the planner."""

import functools
from typing import Any

import numpy as np

from faintspot.experiments import Answer, Question, tune

QUICK: dict[str, Any] = {"realisations": 512, "steps": 1}
CAMERA: dict[str, Any] = {"read_noise_e": 3.0, "pixels": 12, "fwhm_px": 1.77, "flux_e": 200.0}


@functools.cache
def answered(**changes: Any) -> Answer:
    """Return a quick answer, made once."""
    return tune(Question(**{**CAMERA, **changes}), rng=np.random.default_rng(1), **QUICK)
