"""Centroid gains of alternating methods relative to one another."""

from dataclasses import replace

import numpy as np
import pytest
from tests.loop.telemetry.alternation_cases import alternating

from faintspot.loop.telemetry.alternation import relative_gains, turns_of

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
    loop = alternating(600, 50).loop
    found = relative_gains(loop, turns_of(loop, [10, 10]), (0, 1), 0)
    assert found.gain.tolist() == [1.0, 1.0]
    assert found.error.tolist() == [0.0, np.inf]


def test_lost_frames_at_a_change_do_not_count() -> None:
    loop = alternating(3000, 50).loop
    lost = loop.frame + np.arange(3000) // 50 * 3  # three frames are lost at each change
    turns = turns_of(replace(loop, frame=lost), [10, 10])
    assert relative_gains(replace(loop, frame=lost), turns, (0, 1), 0).error[1] == np.inf
