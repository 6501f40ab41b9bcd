"""Errors that all blocks of a method share, such as that of its centroid gain."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.night_cases import night_with

from faintspot.experiments.night.analysis import differences, hours_needed


def test_a_shared_error_widens_intervals_and_does_not_fall_with_time() -> None:
    night = night_with(effect=0.05)
    before = differences(night)[0]
    shared = np.where(night.method == night.reference, 0.0, 0.01)
    after = differences(replace(night, shared_error=shared))[0]
    assert after.measured.value == before.measured.value
    assert after.measured.standard_error == pytest.approx(math.hypot(before.measured.standard_error, 0.01))
    assert after.measured.high - after.measured.value == pytest.approx(
        math.hypot(before.measured.high - before.measured.value, 1.96 * 0.01)
    )
    assert after.hours_needed > before.hours_needed
    too_much = differences(replace(night, shared_error=3 * shared))[0]
    assert too_much.shared_error == pytest.approx(0.03)


def test_hours() -> None:
    assert hours_needed(0.03, 0.02, 1.0) == pytest.approx(4.0)
    assert hours_needed(0.03, math.hypot(0.02, 0.006), 1.0, shared_error=0.006) == pytest.approx(6.25)
    assert hours_needed(0.03, 0.02, 1.0, shared_error=0.01) == math.inf
    assert hours_needed(0.0, 0.02, 1.0) == math.inf
