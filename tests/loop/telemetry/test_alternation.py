"""Turns of methods, and their residual phase."""

from dataclasses import replace

import numpy as np
import pytest
from tests.loop.telemetry.alternation_cases import alternating

from faintspot.loop.telemetry.alternation import phase_of_turn, relative_gains, turns_of

SETTLE = [12, 12]


def test_turns_are_found_in_the_recording() -> None:
    loop = alternating(1020).loop
    loop.method[400:440] = -1  # open
    loop.conditions[700:] = 1
    loop = replace(loop, frame=loop.frame + 5 * (np.arange(1020) >= 155))
    turns = turns_of(loop, [10, 20])
    assert [(turn.method, turn.begin, turn.scored, turn.end) for turn in turns[:4]] == [
        (0, 0, 10, 50),
        (1, 50, 70, 100),
        (0, 100, 110, 150),
        (1, 150, 165, 200),  # 5 of the settling frames were lost
    ]
    spans = [(turn.begin, turn.end) for turn in turns]
    assert (400, 450) not in spans
    assert (440, 450) not in spans  # no frame is left after settling
    assert {turn.conditions for turn in turns if turn.begin >= 700} == {1}
    assert turns[-1].end == 1000  # the last turn is cut short
    assert len(turns_of(loop, [60, 20])) == len([turn for turn in turns if turn.method == 1])


@pytest.mark.parametrize("gains", [(1.0, 1.0), (0.7, 0.95)])
def test_residual_phase_is_the_true_one(gains: tuple[float, float]) -> None:
    known = alternating(gains=gains)
    for method in (0, 1):
        turns = [turn for turn in turns_of(known.loop, SETTLE) if turn.method == method]
        found = [phase_of_turn(known.loop, turn, gains[method]) for turn in turns]
        measured, error = np.array([(each.variance_m2, each.error_m2) for each in found if each]).T
        true = np.array([known.phase_m2[turn.scored : turn.end].mean() for turn in turns])
        assert len(measured) == len(turns) == 60
        deviation = measured - true
        # 60 turns: the mean within 4 standard errors, the standard error itself known to 9 %.
        assert abs(deviation.mean()) < 4 * error.mean() / np.sqrt(60)
        assert deviation.std() == pytest.approx(np.sqrt(np.square(error).mean()), rel=0.35)
        # The noise, which was subtracted, is more than that in method 0.
        assert true.mean() > 5 * error.mean() / np.sqrt(60)


def test_slopes_that_were_not_measured_do_not_count() -> None:
    """A turn of which too little was measured has no phase."""
    loop = alternating(1000).loop
    turns = turns_of(loop, SETTLE)

    def phase() -> float:
        found = [phase_of_turn(loop, turn, 1.0) for turn in turns]
        return float(np.mean([each.variance_m2 for each in found if each]))

    before = phase()
    loop.slopes[np.random.default_rng(2).random(loop.slopes.shape) < 0.02] = np.nan
    assert phase() == pytest.approx(before, rel=0.1)
    loop.slopes[turns[2].scored : turns[2].end, :26] = np.nan
    assert phase_of_turn(loop, turns[2], 1.0) is None


SPECKLES = 0.1


def test_gains_are_found() -> None:
    loop = alternating(4000, 25, gains=(0.7, 0.95), noise_px=(0.03, 0.03)).loop
    turns = turns_of(loop, [10, 10])
    found = relative_gains(loop, turns, (0, 1), 0)
    assert (found.gain[0], found.error[0]) == (1.0, 0.0)
    ratio = 0.95 / 0.7
    statistical = np.sqrt((found.error[1] / found.gain[1]) ** 2 - SPECKLES**2)
    assert 0 < statistical < 0.06
    assert abs(found.gain[1] / ratio - 1) < 3 * statistical
    other = relative_gains(loop, turns, (0, 1), 1)
    assert other.gain[0] == pytest.approx(1 / found.gain[1])


def test_methods_that_share_a_gain() -> None:
    loop = alternating(4000, 25, gains=(1.0, 1.0, 0.8), noise_px=(0.03, 0.04, 0.03)).loop
    found = relative_gains(loop, turns_of(loop, [10] * 3), (4, 4, 7), 0)
    assert found.gain[:2].tolist() == [1.0, 1.0]
    assert found.error[:2].tolist() == [0.0, 0.0]
    assert found.gain[2] == pytest.approx(0.8, rel=0.15)


def test_too_few_changes_are_no_measurement() -> None:
    """Nor are changes at which three frames were lost."""
    loop = alternating(3000, 50).loop
    lost = replace(loop, frame=loop.frame + np.arange(3000) // 50 * 3)
    for few in (alternating(600, 50).loop, lost):
        found = relative_gains(few, turns_of(few, [10, 10]), (0, 1), 0)
        assert (found.gain.tolist(), found.error.tolist()) == ([1.0, 1.0], [0.0, np.inf])
