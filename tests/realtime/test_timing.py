from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintspot.base.errors import InputError
from faintspot.realtime.timing import RESOLUTION, Counters, Latencies

# From nothing to 130 s, each order of magnitude as likely as the others.
durations = st.integers(0, 37).flatmap(lambda bits: st.integers(0, 2**bits - 1))
many = st.lists(durations, min_size=1, max_size=300)


def filled(values: list[int]) -> Latencies:
    latencies = Latencies()
    for value in values:
        latencies.add(value)
    return latencies


@given(many, st.sampled_from([0.0, 1.0, 25.0, 50.0, 90.0, 99.0, 99.9, 100.0]))
def test_percentiles_are_numpys_within_the_resolution(values: list[int], percent: float) -> None:
    found = filled(values).percentile_ns(percent)
    # Half a bin: bins hold their durations to 2^-8, exactly below 256 ns. Where rounding of percent x count
    # may turn the rank, its neighbour is right too.
    exact = {
        float(np.percentile(values, min(max(percent + nudge, 0), 100), method="inverted_cdf"))
        for nudge in (-1e-6, 0, 1e-6)
    }
    assert min(abs(found - each) - RESOLUTION * each for each in exact) <= 1e-9


@given(many)
def test_count_mean_and_extremes_are_exact(values: list[int]) -> None:
    latencies = filled(values)
    assert latencies.count == len(values)
    assert latencies.mean_ns == sum(values) / len(values)
    assert (latencies.smallest_ns, latencies.largest_ns) == (min(values), max(values))


@given(many, many)
def test_merging_is_adding_both(first: list[int], second: list[int]) -> None:
    parts = filled(first), filled(second)
    merged = parts[0].merge(parts[1])
    assert merged.as_dict() == filled(first + second).as_dict()
    assert parts[0].as_dict() == filled(first).as_dict()
    assert parts[1].merge(Latencies()).as_dict() == parts[1].as_dict()


@given(many)
def test_the_distribution_holds_every_duration(values: list[int]) -> None:
    lowest, highest, counts = filled(values).distribution()
    for value in values:
        assert ((lowest <= value) & (value <= highest)).sum() == 1
    array = np.array(values)
    inside = [((array >= a) & (array <= b)).sum() for a, b in zip(lowest, highest, strict=True)]
    np.testing.assert_array_equal(counts, inside)
    assert np.all(highest - lowest <= lowest / 128)  # below 1 %


def test_what_is_beyond_the_range_is_counted_with_its_true_largest() -> None:
    latencies = filled([-5, 2**40])
    assert (latencies.count, latencies.smallest_ns, latencies.largest_ns) == (2, 0, 2**40)
    assert latencies.percentile_ns(100) == 2**40


def test_without_durations_there_is_nothing_to_tell() -> None:
    latencies = Latencies()
    assert latencies.count == 0
    assert math.isnan(latencies.percentile_ns(50))
    assert set(latencies.as_dict().values()) == {0, None}


def test_reset_forgets_everything() -> None:
    latencies = filled([300, 5_000])
    latencies.reset()
    assert latencies.as_dict() == Latencies().as_dict()
    latencies.add(7_000)
    assert latencies.as_dict()["min_us"] == 7.0


def test_dict_is_in_microseconds_and_goes_through_json() -> None:
    found = json.loads(json.dumps(filled([1_000] * 999 + [9_000_000]).as_dict()))
    assert found["count"] == 1000
    assert found["max_us"] == 9000
    assert found["p99_9_us"] == pytest.approx(1, rel=RESOLUTION)
    assert list(found) == ["count", "mean_us", "min_us", "p50_us", "p99_us", "p99_9_us", "max_us"]


@pytest.mark.parametrize("percent", [-1, 101, math.nan])
def test_a_percentage_that_is_none_is_refused(percent: float) -> None:
    with pytest.raises(InputError, match="percent"):
        Latencies().percentile_ns(percent)


def test_counters_are_plain_numbers() -> None:
    counters = Counters()
    counters.dropped += 2
    assert counters.as_dict() == {**Counters().as_dict(), "dropped": 2}
    assert set(Counters().as_dict().values()) == {0}
