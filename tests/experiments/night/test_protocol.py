from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import small
from tests.experiments.night_cases import night_with
from tests.refusals import assert_each_refused, refused

from faintspot.experiments.night.protocol import (
    COUNTS,
    NONE,
    QUICK_PLAN,
    Night,
    NightPlan,
    counts_per_e,
)
from faintspot.loop.simulation import load_loop
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation


def test_each_cycle_begins_without_tv_and_strengths_rise() -> None:
    plan = NightPlan()
    for number, strengths in enumerate((8, 20, 8, 20)):
        (first, none), *rising = plan.entries(number)
        assert first == NONE
        assert np.isnan(none)
        assert len(rising) == strengths
        np.testing.assert_allclose([strength for _, strength in rising], np.linspace(0, 2, strengths))
        schedule = plan.schedule(number)
        assert len(schedule) == plan.frames(number)
        np.testing.assert_array_equal(
            schedule[:: plan.block_frames][: strengths + 1], np.arange(strengths + 1)
        )
        assert schedule[(strengths + 1) * plan.block_frames] == 0  # again from the beginning


def test_sets_follow_one_another() -> None:
    """The night is the paper's: sets with 8 or 20 strengths, repeated: a little more than an hour."""
    for plan in (NightPlan(), QUICK_PLAN):
        firsts = np.concatenate([plan.first_frames(number) for number in range(plan.sets)])
        np.testing.assert_array_equal(firsts, 4650 * np.arange(len(firsts)))  # 31 s at 150 frames/s
        numbers = plan.frame_numbers(1)
        assert len(numbers) == plan.frames(1) == len(plan.schedule(1))
        np.testing.assert_array_equal(numbers[:: plan.block_frames], plan.first_frames(1))
        assert numbers[plan.block_frames - 1] == plan.first_frames(1)[0] + plan.block_frames - 1
    plan, loop = NightPlan(), load_loop("canary")
    assert [plan.blocks(number) for number in range(4)] == [18, 42, 18, 42]
    hours = 120 * (plan.block_frames + plan.gap_frames) / loop.control.frame_rate_hz / 3600
    assert 1 < hours < 1.1
    # 500 to 1,000 counts, with the full multiplication gain and with 75 % of it.
    signals = [loop.photons * counts_per_e(plan.configuration(loop, number)) for number in range(4)]
    np.testing.assert_allclose(signals, [750, 750, 562.5, 562.5])
    # Without multiplication there is nothing to lower.
    assert [plan.configuration(small(), number).camera.em_gain for number in (0, 3)] == [1, 1]


def test_strengths_in_counts_follow_the_multiplication_gain() -> None:
    loop = small().replace("camera", em_gain=300.0, gain_e_per_adu=10.0)
    plan = NightPlan(unit=COUNTS, listed_strengths=(0.6, 1.5))
    for number, counts in ((0, 30.0), (2, 22.5)):  # 300 / 10, and three quarters of it
        whole = plan.configuration(loop, number)
        assert counts_per_e(whole) == counts
        _, *tv = plan.made(whole, number)
        noise = [method.estimator.noise_std for method in tv]  # type: ignore[attr-defined]
        np.testing.assert_allclose(noise, [0.6 / counts, 1.5 / counts])
        assert [method.label for method in tv] == ["TV 0.6 counts", "TV 1.5 counts"]


def test_methods_share_pixels_and_loop_gain() -> None:
    none, *tv = NightPlan(keep_brightest=30).made(small(), 0)
    assert isinstance(none.estimator, BrightestPixels)
    assert none.label == "no TV"
    assert {method.estimator.keep_brightest for method in (none, *tv)} == {30}  # type: ignore[attr-defined]
    assert {(method.gain, method.corrects_gain) for method in (none, *tv)} == {(None, False)}
    assert all(isinstance(method.estimator, TotalVariation) for method in tv)
    assert [method.estimator.noise_std for method in tv][-1] == 2  # type: ignore[attr-defined]
    plan = NightPlan(methods=("window", "none", "tv"), listed_strengths=(0.4, 0.8))
    assert [name for name, _ in plan.entries(0)] == ["window", "none", "tv", "tv"]
    labels = [method.label for method in plan.made(small(), 0)]
    assert labels == ["fixed window", "no TV", "TV 0.4 e-", "TV 0.8 e-"]


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    assert_each_refused(
        partial(replace, NightPlan()),
        block_frames=[90],
        repeats=[(1, 1)],
        methods=[("none",), ("none", "none")],
    )
    for changes, words in (
        ({"methods": ("none", "map+kalman")}, "integrator"),
        ({"methods": ("none", "nothing")}, "nothing"),
        ({"listed_strengths": (-1.0,)}, "strengths"),
        ({"strengths": (1, 8, 8, 8)}, "plan.strengths = 1"),
        ({"em_fractions": (0.0, 1.0, 1.0, 1.0)}, "plan.em_fractions = 0"),
    ):
        wrong: Any = changes
        with refused(words):
            NightPlan(**wrong)
    assert_each_refused(partial(replace, night_with()), strehl=[np.zeros(3)], reference=[99])
    for name, word in (("labels", "method"), ("set_names", "set_number")):
        names: Any = {name: ("one",)}
        with refused(word):
            replace(night_with(), **names)
    np.savez(tmp_path / "other.npz", strehl=np.zeros(3))
    with refused("format 2"):
        Night.load(tmp_path / "other.npz")


def test_a_night_is_read_as_it_was_written(tmp_path: Path) -> None:
    night = night_with()
    night.save(tmp_path / "night.npz")
    night.save(tmp_path / "night.npz")  # over itself
    again = Night.load(tmp_path / "night.npz")
    for item in fields(Night):
        before, after = getattr(night, item.name), getattr(again, item.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(after, before)
            assert after.dtype == before.dtype
        else:
            assert after == before


def test_cycles_begin_with_the_reference_and_with_sets() -> None:
    night = night_with()
    rows = np.flatnonzero(night.set_number < 2)
    cycle = night.cycle[rows]
    assert cycle.max() == 5  # 4 of the first set, 2 of the second
    first = np.flatnonzero(np.diff(cycle, prepend=-1))
    assert (night.method[rows][first] == night.reference).all()
    moved = replace(night, method=np.where(np.arange(len(night.strehl)) == 0, 1, night.method))
    assert moved.cycle[0] == 0  # a set that does not begin with the reference
    assert night.hours == pytest.approx(len(night.strehl) * 2.4 / 3600)  # with settling
