import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import ArrayLike, NDArray
from tests.experiments.experiment_cases import small
from tests.experiments.result_cases import made_up_magnitude
from tests.patience import mostly_slow
from tests.refusals import refused

from faintspot.base.statistics import mean_by_blocks
from faintspot.experiments.closed_loop.results import (
    LOOP_GAIN,
    MagnitudeResult,
    default_methods,
    differences_by_flux,
    falling,
    gains_in_magnitude,
    magnitude_gain,
    magnitude_limit,
    tuned_values,
    with_choice,
)
from faintspot.experiments.methods import crossings
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.record import MAGNITUDE_FILE, holds_loop_results, make_folder
from faintspot.loop.simulation.simulation import simulate_loop
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimators


def assert_equal(one: Any, other: Any) -> None:
    assert type(one) is type(other)
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(other, name))
            assert value.dtype == getattr(other, name).dtype
        else:
            assert value == getattr(other, name)


def test_magnitude_is_read_as_written(tmp_path: Path) -> None:
    result = made_up_magnitude()
    result.strehl[1, 2, 3] = np.nan
    assert not holds_loop_results(tmp_path)
    result.save(tmp_path / MAGNITUDE_FILE)
    assert holds_loop_results(tmp_path)
    assert_equal(MagnitudeResult.load(tmp_path / MAGNITUDE_FILE), result)
    assert [path.name for path in tmp_path.iterdir()] == [MAGNITUDE_FILE]


def test_folders_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "a" / "b", tmp_path / "file"):
        with refused(str(folder)):
            make_folder(folder)


MAGNITUDES = np.linspace(8.0, 13.0, 6)
numbers = arrays(np.float64, st.integers(1, 12), elements=st.floats(-1, 1))


def _crossed(magnitudes: ArrayLike, strehl: ArrayLike, level: float, **options: bool) -> NDArray[np.float64]:
    return crossings(np.asarray(magnitudes, np.float64), falling(strehl), level, **options)


def curves(shift: float, realisations: int = 6, scatter: float = 0.02) -> np.ndarray:
    atmosphere = np.random.default_rng(2).normal(0, scatter, realisations)  # the same for every method
    return 0.7 - 0.1 * (MAGNITUDES[:, None] - shift - 8) + atmosphere


@given(numbers)
def test_falling_is_pool_adjacent_violators(values: np.ndarray) -> None:
    """Many curves at once are as one by one."""
    pools: list[list[float]] = []
    for value in values:
        pools.append([float(value)])
        while len(pools) > 1 and np.mean(pools[-2]) < np.mean(pools[-1]):
            pools[-2:] = [pools[-2] + pools[-1]]
    expected = np.concatenate([[np.mean(pool)] * len(pool) for pool in pools])
    many = np.stack([values, np.sort(values), 0 * values])
    np.testing.assert_allclose(falling(many)[0], expected, atol=1e-9)
    assert (np.diff(falling(many)) <= 1e-12).all()
    np.testing.assert_allclose(falling(many), [falling(one) for one in many])


def test_the_limiting_magnitude_lies_between_points() -> None:
    assert _crossed([8, 9, 10], [0.6, 0.5, 0.3], 0.4, straight=True) == pytest.approx(9.5)
    assert _crossed([8, 9, 10], [0.5, 0.4, 0.3], 0.35) == pytest.approx(9.5)
    assert _crossed([8, 9, 10], [0.6, 0.5, 0.3], 0.5) == pytest.approx(9.0)
    assert _crossed([8, 9], [0.6, 0.5], 0.4) == math.inf
    assert _crossed([8, 9], [0.3, 0.2], 0.4) == -math.inf
    many = np.random.default_rng(9).uniform(0, 1, (50, 6))
    one_by_one = [_crossed(MAGNITUDES, one, 0.5) for one in many]
    np.testing.assert_allclose(_crossed(MAGNITUDES, many, 0.5), one_by_one)


@pytest.mark.parametrize("apart", mostly_slow(1, [0.5, 1.0, 1.5]))
def test_limits_of_curves_that_bend_hold_within_their_errors(apart: float) -> None:
    """A third of the error of straight lines, which is the error that is stated."""
    wrong, stated, straight = [], [], []
    for middle in np.linspace(10.0, 11.0, 9):
        for level in (0.15, 0.3, 0.45):
            faint = np.arange(7.0, 14.5, apart)
            strehl = 0.6 / (1 + np.exp((faint - middle) / 0.7))
            truth = middle + 0.7 * np.log(0.6 / level - 1)
            limit = magnitude_limit(faint, np.tile(strehl[:, None], 6), level)
            wrong.append(limit.value - truth)
            stated.append(limit.standard_error)
            straight.append(float(_crossed(faint, strehl, level, straight=True)) - truth)
    rms, of_lines = (float(np.sqrt(np.square(errors).mean())) for errors in (wrong, straight))
    assert rms < 0.6 * of_lines
    assert rms < float(np.sqrt(np.square(stated).mean())) < 1.5 * of_lines


def bent(faint: ArrayLike, middle: float) -> NDArray[np.float64]:
    """Return Strehl ratios of six equal runs, (magnitudes, 6)."""
    curve = 0.6 / (1 + np.exp((np.asarray(faint) - middle) / 0.5))
    return np.tile(curve[:, None], 6)


def test_a_gain_between_curves_that_bend_differently_is_not_that_of_lines() -> None:
    """Stars 1.5 magnitudes apart: lines are wrong by more than the error, which both results state.

    Two stars show no bend, and the interval says so.
    """
    faint = np.arange(7.0, 14.5, 1.5)
    gain = magnitude_gain(faint, bent(faint, 11.0), bent(faint, 10.25), 0.15)
    assert gain.standard_error > 0.02
    assert abs(gain.value - 0.75) < 2 * gain.standard_error
    assert gain.low < 0.75 < gain.high
    two = [9.0, 10.5]
    found = magnitude_gain(two, bent(two, 10.4), bent(two, 9.8), 0.35)
    assert found.standard_error == pytest.approx(1.5 * math.sqrt(2 / 12))
    assert found.low < 0.6 < found.high
    assert abs(found.value - 0.6) > 0.05


def test_the_gain_is_the_shift_between_two_curves() -> None:
    # Straight lines moved by 0.3 mag; air that is common to both moves them together.
    found = magnitude_gain(MAGNITUDES, curves(0.3), curves(0.0), 0.45)
    assert (found.value, found.low, found.high) == pytest.approx((0.3, 0.3, 0.3))
    assert found.decided == 1
    assert magnitude_gain(MAGNITUDES[::-1], curves(0.3)[::-1], curves(0.0)[::-1], 0.45) == found
    of_two = magnitude_gain(MAGNITUDES, curves(0.3, 2), curves(0.0, 2), 0.45)
    assert of_two.value == pytest.approx(0.3)
    assert math.isnan(of_two.low)


def test_a_gain_beyond_what_was_measured_is_not_made_up() -> None:
    """An interval that leaves the magnitudes is open; what is not measured yet is left out."""
    shifts = (3.0, 0.0), (0.0, 3.0), (3.0, 3.0)
    gains = [magnitude_gain(MAGNITUDES, curves(one), curves(other), 0.35).value for one, other in shifts]
    assert gains == pytest.approx([math.inf, -math.inf, math.nan], nan_ok=True)
    found = magnitude_gain(MAGNITUDES, curves(0.9, scatter=0.1), curves(0.0, scatter=0.0), 0.31)
    assert math.isfinite(found.value)
    assert found.high == math.inf
    missing = curves(0.3)
    missing[0, 2] = np.nan
    assert magnitude_gain(MAGNITUDES, missing, curves(0.0), 0.45).value == pytest.approx(0.3)
    assert math.isnan(magnitude_gain(MAGNITUDES, missing * np.nan, curves(0.0), 0.45).value)


def test_block_intervals_hold_as_often_as_they_say() -> None:
    # 300 series of 40 values: 95 % holds within 4 % (three standard errors), and narrow series are honest.
    rng = np.random.default_rng(8)
    inside = 0
    for _ in range(300):
        found = mean_by_blocks(rng.normal(1.0, 0.5, 40))
        inside += found.low <= 1.0 <= found.high
    assert 0.91 <= inside / 300 <= 0.99


def test_gains_in_magnitude_are_those_of_the_curves() -> None:
    result = made_up_magnitude(0.3)
    gains = gains_in_magnitude(result, 1, 0)
    assert list(gains)[:2] == [0.05, 0.1]
    assert gains[0.3].value == pytest.approx(0.3, abs=0.05)
    assert gains[0.3].decided == 1


def test_differences_by_flux_are_paired() -> None:
    result = made_up_magnitude(0.3)
    for estimate, runs in zip(
        differences_by_flux(result, 1, 0), result.strehl[1] - result.strehl[0], strict=True
    ):
        assert estimate.value == pytest.approx(runs.mean())
        assert estimate.high - estimate.low < 0.02  # the air's 0.02 is common to both


NAMES = (*estimators(), "ml+weighted", "map+predicted+weighted", "tv+uncorrected")


def first_choice(name: str) -> dict[str, Any]:
    return {key: each.first[-1] for key, each in tuned_values(Method.named(name), BRIGHT).items()} | {
        LOOP_GAIN: 0.2
    }


BRIGHT = small().replace("camera", photons_per_subaperture=1000.0)


@pytest.mark.parametrize("name", mostly_slow(2, NAMES))
def test_every_method_closes_the_loop(name: str) -> None:
    """Not for long and not well, but better than no correction: Strehl ratio 0.17 then."""
    kind = Method.named(name)
    record = simulate_loop(BRIGHT, [with_choice(kind, BRIGHT, first_choice(name))])
    assert record.labels == (kind.label,)
    assert np.isfinite(record.slopes_px).all()
    assert record.mean_strehl() > 0.35


def test_names_say_what_the_loop_does() -> None:
    for name in NAMES:
        assert Method.named(name).name == name
    assert Method.named("map+weighted+predicted").name == "map+predicted+weighted"
    name = "map+predicted+weighted"
    method = with_choice(Method.named(name), BRIGHT, first_choice(name))
    assert method.is_predicted
    assert method.variants == ("predicted", "weighted")
    assert not method.corrects_gain
    assert Method.named("weighted").variants == ()
    assert len({Method.named(name).label for name in NAMES}) == len(NAMES)


def test_defaults_suit_the_configuration() -> None:
    usual = default_methods(small())
    assert set(estimators()) <= set(usual)
    assert {"ml+weighted", "map+predicted", "map+predicted+weighted"} <= set(usual)
    assert not any(name.endswith("+uncorrected") for name in usual)
    assert "tv+uncorrected" in default_methods(small().replace("control", mode="open"))


def test_an_estimator_of_ones_own_is_an_method(
    own_estimator: type[Estimator], monkeypatch: pytest.MonkeyPatch
) -> None:
    powers = [2.0, 1.5, 3.0, 4.0, 5.0]
    monkeypatch.setattr(own_estimator, "tuned", lambda self, scene: {"power": powers})
    assert "own" in default_methods(small())
    kind = Method.named("own+uncorrected")
    tuned = tuned_values(kind, BRIGHT)
    # Two steps beyond each end, as far as the option goes.
    assert tuned["power"].values == pytest.approx((1.125, 1.5, 2.0, 3.0, 4.0, 5.0, 6.25, 7.8125))
    assert tuned["power"].first == pytest.approx((1.5, 4.0, 6.25))
    record = simulate_loop(BRIGHT, [with_choice(kind, BRIGHT, {LOOP_GAIN: 0.3, "power": 2.0})])
    assert record.mean_strehl() > 0.35


def test_first_values_are_among_all() -> None:
    for name in NAMES:
        for each in tuned_values(Method.named(name), small()).values():
            assert set(each.first) <= set(each.values)
            assert list(each.values) == sorted(set(each.values))


def test_unknown_methods_and_missing_values() -> None:
    with refused("estimator = 'kog'", "'brightest'"):
        Method.named("kog")
    with refused("method = 'tv+predicted'"):
        Method.named("tv+predicted")
    with refused("choice", "'keep_brightest'", "'brightest'"):
        with_choice(Method.named("brightest"), small(), {LOOP_GAIN: 0.5})
