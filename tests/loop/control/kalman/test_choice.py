"""Choice of the controller that drives the mirror, by measured residuals."""

import math

import numpy as np
import pytest

from faintspot.loop.control.kalman.guarded import (
    AT_LIMIT,
    CHOOSE,
    CHOSEN,
    GUARD_NUMBERS,
    LEFT_OUT,
    SURPRISE,
    prepare,
)


def driven(filters: float, integrators: float, frames: int, computed: float = math.inf) -> np.ndarray:
    """Return what was chosen; whatever drives, the residual of the integrator is computed as 3."""
    guard = np.zeros(GUARD_NUMBERS)
    prepare(guard, False, computed, 60, 36)
    chosen = []
    for _ in range(frames):
        chosen.append(guard[CHOSEN])
        learnt, plain = (filters, 3.0) if guard[CHOSEN] == 0 else (0.5, integrators)
        CHOOSE(guard, learnt, plain)
    return np.array(chosen)


def test_integrator_drives_first() -> None:
    chosen = driven(0.8, 1.0, 500)
    assert chosen[:60].all()
    assert not chosen[62:].any()


@pytest.mark.parametrize(
    ("prefers_plain", "ratio", "drives"), [(False, 0.95, 1), (True, 0.98, 0), (False, 1.05, 0)]
)
def test_few_commands_follow_their_recording_unless_residuals_contradict(
    prefers_plain: bool, ratio: float, drives: int
) -> None:
    """Residuals of two commands scatter so much that in 450 frames they show no difference of 2 %."""
    guard, rng = np.zeros(GUARD_NUMBERS), np.random.default_rng(1)
    prepare(guard, prefers_plain, math.inf, 60, 2)
    for plain in rng.chisquare(2, 450):
        CHOOSE(guard, ratio * plain * math.exp(0.2 * rng.standard_normal()), plain)
    assert guard[CHOSEN] == 1 - drives


def test_filter_that_leaves_more_loses_the_mirror_though_its_model_says_less() -> None:
    """Each time for twice as long."""
    chosen = driven(1.5, 1.0, 4000)
    changes = np.flatnonzero(np.diff(chosen))
    assert changes[0] == 60
    assert changes[1] < 110
    waits = changes[2::2] - changes[1:-1:2]
    assert waits[0] >= 500
    assert (np.diff(waits) > 0.9 * waits[:-1]).all()


def test_runaway_loses_the_mirror_at_once_and_for_good() -> None:
    chosen = driven(1e6, 1.0, 10_000)
    assert np.count_nonzero(chosen == 0) == 1


def test_growing_residual_loses_the_mirror_before_it_is_ten_times_as_large() -> None:
    guard = np.zeros(GUARD_NUMBERS)
    prepare(guard, False, math.inf, 60, 36)
    for _ in range(61):
        CHOOSE(guard, 0.5, 1.0)
    residual, frames = 0.5, 0
    while guard[CHOSEN] == 0:
        residual, frames = 1.2 * residual, frames + 1
        CHOOSE(guard, residual, 3.0)
    assert frames > 5  # not before it is as large as that of the integrator
    assert residual < 10
    for _ in range(5000):
        CHOOSE(guard, 0.5, 1.0)
    assert guard[CHOSEN] == 1


def test_a_filter_that_becomes_worse_is_replaced_within_30_frames_without_false_alarms() -> None:
    """Both residuals share the turbulence, and each has a scatter that is alike over five frames."""
    rng = np.random.default_rng(3)
    guard, chosen = np.zeros(GUARD_NUMBERS), []
    prepare(guard, False, math.inf, 60, 36)
    scatter = [
        np.exp(0.15 * np.convolve(rng.standard_normal(10_004), np.full(5, 5**-0.5), "valid"))
        for _ in range(2)
    ]
    for frame in range(10_000):
        learnt = (0.8 if frame < 9000 else 1.3) * scatter[0][frame]
        CHOOSE(guard, learnt, scatter[1][frame])
        chosen.append(guard[CHOSEN])
    assert np.flatnonzero(np.diff(chosen)).tolist()[0] < 100
    assert not np.any(chosen[100:9000])
    assert chosen[9030] == 1


@pytest.mark.parametrize(
    ("measure", "usual", "bad", "frames"),
    [
        (AT_LIMIT, 0.0, 1.0, 20),
        (AT_LIMIT, 3.0, 3.0, None),
        (SURPRISE, 1.0, 2.5, 20),
        (SURPRISE, 1.3, 1.6, None),
        (LEFT_OUT, 0.0, 2.5, 30),
        (LEFT_OUT, 1.5, 1.8, None),
    ],
)
def test_a_filter_is_replaced_though_it_leaves_little(
    measure: int, usual: float, bad: float, frames: int | None
) -> None:
    """By commands at the limit, surprises, or slopes that are not used; not where the integrator has them."""
    guard = np.zeros(GUARD_NUMBERS)
    prepare(guard, False, math.inf, 60, 36)
    chosen = []
    for number in range(400):
        driving = guard[CHOSEN] == 0
        guard[SURPRISE] = 1.0
        guard[measure] = bad if driving and number > 100 else usual
        CHOOSE(guard, 0.5, 1.0)
        chosen.append(guard[CHOSEN])
    assert not any(chosen[65:101])
    assert any(chosen[101:]) == (frames is not None)
    if frames is not None:
        assert chosen[100 + frames] == 1
