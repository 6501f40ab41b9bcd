"""Choice of the controller that drives the mirror, by measured residuals."""

from __future__ import annotations

import math

import numpy as np

from faintspot.loop.control.kalman.choice import CHOOSE, CHOSEN, GUARD_NUMBERS, prepare


def driven(filters: float, integrators: float, frames: int, computed: float = math.inf) -> np.ndarray:
    """Return what was chosen; whatever drives, the residual of the integrator is computed as 3."""
    guard = np.zeros(GUARD_NUMBERS)
    prepare(guard, False, computed, 60)
    chosen = []
    for _ in range(frames):
        chosen.append(guard[CHOSEN])
        learnt, plain = (filters, 3.0) if guard[CHOSEN] == 0 else (0.5, integrators)
        CHOOSE(guard, learnt, plain)
    return np.array(chosen)


def test_integrator_drives_first() -> None:
    chosen = driven(0.8, 1.0, 500)
    assert chosen[:60].all()
    assert not chosen[60:].any()


def test_filter_that_leaves_more_loses_the_mirror_though_its_model_says_less() -> None:
    """Each time for twice as long."""
    chosen = driven(2.0, 1.0, 4000)
    changes = np.flatnonzero(np.diff(chosen))
    assert changes[0] == 59
    assert changes[1] < 110
    waits = changes[2::2] - changes[1:-1:2]
    assert (np.diff(waits) > 0.9 * waits[:-1]).all()


def test_runaway_loses_the_mirror_at_once() -> None:
    chosen = driven(1e6, 1.0, 300)
    assert np.count_nonzero(chosen == 0) == 1
