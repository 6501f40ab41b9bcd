from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.experiment_cases import small
from tests.refusals import refused

from faintspot.experiments.night.protocol import NONE, QUICK_PLAN, TV, NightPlan
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
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
    plan = QUICK_PLAN
    assert plan.first_frame(0) == 0
    for number in range(1, plan.sets):
        assert plan.first_frame(number) == plan.first_frame(number - 1) + plan.frames(number - 1)


def test_multiplication_gain_is_full_and_then_three_quarters() -> None:
    loop = small().replace("camera", em_gain=400.0)
    gains = [NightPlan().configuration(loop, number).camera.em_gain for number in range(4)]
    assert gains == [400, 400, 300, 300]
    plain = NightPlan().configuration(small(), 3)
    assert plain.camera.em_gain == 1  # without multiplication there is nothing to lower


def test_methods_share_pixels_and_loop_gain_when_nothing_is_tuned() -> None:
    none, *tv = NightPlan(keep_brightest=30).made(small(), 0, {})
    assert isinstance(none.estimator, BrightestPixels)
    assert none.label == "no TV"
    assert {method.estimator.keep_brightest for method in (none, *tv)} == {30}  # type: ignore[attr-defined]
    assert {method.gain for method in (none, *tv)} == {None}
    assert all(isinstance(method.estimator, TotalVariation) for method in tv)
    assert [method.estimator.noise_std for method in tv][-1] == 2  # type: ignore[attr-defined]


def test_tuned_values_are_used_except_for_the_strength() -> None:
    choices = {
        NONE: {"loop_gain": 0.3, "keep_brightest": 12},
        TV: {"loop_gain": 0.2, "keep_brightest": 20, "noise_std": 9.0},
    }
    none, *tv = NightPlan(strengths_e=(0.5, 1.5)).made(small(), 0, choices)
    assert (none.gain, none.estimator.keep_brightest) == (0.3, 12)  # type: ignore[attr-defined]
    assert [(method.gain, method.estimator.noise_std) for method in tv] == [(0.2, 0.5), (0.2, 1.5)]  # type: ignore[attr-defined]


def test_each_subaperture_may_have_its_own_strength() -> None:
    factors = tuple(np.linspace(0.5, 1, 12))
    method = NightPlan(strengths_e=(2.0,), strength_factors=factors).made(small(), 0, {})[1]
    np.testing.assert_allclose(method.estimator.values("noise_std", 12, 64), 2 * np.array(factors))


def test_other_methods_are_one_block_of_a_cycle() -> None:
    plan = NightPlan(methods=("window", "none", "tv"), strengths_e=(0.4, 0.8))
    assert [name for name, _ in plan.entries(0)] == ["window", "none", "tv", "tv"]
    labels = [method.label for method in plan.made(small(), 0, {})]
    assert labels == ["fixed window", "no TV", "TV 0.4 e-", "TV 0.8 e-"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"block_frames": 110}, "plan.block_frames = 110"),
        ({"repeats": (1, 1)}, "for each set"),
        ({"methods": ("none",)}, "two or more"),
        ({"methods": ("none", "none")}, "two or more"),
        ({"methods": ("none", "map+kalman")}, "expected the integrator"),
        ({"methods": ("none", "nothing")}, "nothing"),
        ({"strengths_e": (-1.0,)}, "strengths"),
        ({"strengths": (1, 8, 8, 8)}, "plan.strengths = 1"),
        ({"em_fractions": (0.0, 1.0, 1.0, 1.0)}, "plan.em_fractions = 0"),
    ],
)
def test_what_cannot_be_observed_is_refused(changes: dict[str, object], words: str) -> None:
    with refused(words):
        replace(NightPlan(), **changes)  # type: ignore[arg-type]
