import json
import mmap

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintspot.engine.frames.timing import (
    IN_TIME,
    OTHER,
    PAGE_FAULT,
    PREPARING,
    WOKEN_LATE,
    Latencies,
    Lateness,
)

RESOLUTION = 1 / 256
# From nothing to 130 s, each order of magnitude as likely as the others.
durations = st.integers(0, 37).flatmap(lambda bits: st.integers(0, 2**bits - 1))
many = st.lists(durations, min_size=1, max_size=300)


def filled(values: list[int]) -> Latencies:
    latencies = Latencies()
    for value in values:
        latencies.add(value)
    return latencies


@given(many)
def test_figures_are_those_of_numpy(values: list[int]) -> None:
    """Percentiles within half a bin: bins hold their durations to 2^-8, exactly below 256 ns."""
    found = filled(values).as_dict()
    assert (found["count"], found["mean_us"]) == (len(values), sum(values) / len(values) / 1e3)
    assert (found["min_us"], found["max_us"]) == (min(values) / 1e3, max(values) / 1e3)
    for name, percent in (("p50_us", 50.0), ("p99_us", 99.0), ("p99_9_us", 99.9)):
        # Where rounding of percent x count may turn the rank, its neighbour is right too.
        exact = {
            float(np.percentile(values, min(percent + nudge, 100), method="inverted_cdf"))
            for nudge in (-1e-6, 0, 1e-6)
        }
        percentile_ns = 1e3 * (found[name] or 0.0)
        assert min(abs(percentile_ns - each) - RESOLUTION * each for each in exact) <= 1e-6


def test_what_is_beyond_the_range_is_counted_with_its_true_largest() -> None:
    found = filled([-5, *[2**40] * 3]).as_dict()
    largest = 2**40 / 1e3
    assert [found[name] for name in ("count", "min_us", "p99_us", "max_us")] == [4, 0, largest, largest]
    assert set(Latencies().as_dict().values()) == {0, None}


def test_dict_is_in_microseconds_and_goes_through_json() -> None:
    found = json.loads(json.dumps(filled([1_000] * 999 + [9_000_000]).as_dict()))
    assert found["count"] == 1000
    assert found["max_us"] == 9000
    assert found["p99_9_us"] == pytest.approx(1, rel=RESOLUTION)
    assert list(found) == ["count", "mean_us", "min_us", "p50_us", "p99_us", "p99_9_us", "max_us"]


def test_a_frame_in_time_has_no_cause() -> None:
    assert Lateness().cause(False, True, 1, 0) == IN_TIME
    assert Lateness().cause(True, True, 1, 0) == PREPARING


def test_a_page_that_was_missing() -> None:
    lateness = Lateness()
    lateness.cause(False, False, 0, 0)
    with mmap.mmap(-1, 1 << 20) as memory:
        memory[1 << 19] = 1
        assert lateness.cause(True, False, 0, 0) == PAGE_FAULT


def test_only_what_has_happened_since_the_frame_before_counts() -> None:
    lateness = Lateness()
    causes = set()
    for _ in range(20):  # now and then something really happens
        lateness.cause(False, False, 3, 0)
        causes.add(lateness.cause(True, False, 3, 0))
    assert OTHER in causes
    assert WOKEN_LATE not in causes
    assert any(lateness.cause(True, False, 4 + k, 0) == WOKEN_LATE for k in range(20))
