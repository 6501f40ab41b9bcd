from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import small

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, default_methods, tuned_values, with_choice
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.simulation import simulate_loop
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimators

NAMES = (*estimators(), "ml+weighted", "map+predicted+weighted", "tv+uncorrected")


def first_choice(name: str) -> dict[str, Any]:
    return {key: each.first[-1] for key, each in tuned_values(Method.named(name), BRIGHT).items()} | {
        LOOP_GAIN: 0.2
    }


BRIGHT = small().replace("camera", photons_per_subaperture=1000.0)


@pytest.mark.parametrize("name", NAMES)
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


@pytest.mark.parametrize("name", NAMES)
def test_first_values_are_among_all(name: str) -> None:
    for each in tuned_values(Method.named(name), small()).values():
        assert set(each.first) <= set(each.values)
        assert list(each.values) == sorted(set(each.values))


def test_unknown_methods_and_missing_values() -> None:
    with pytest.raises(InputError, match=r"^estimator = 'kog': expected one of 'brightest'"):
        Method.named("kog")
    with pytest.raises(InputError, match=r"method = 'tv.predicted': expected an estimator that takes"):
        Method.named("tv+predicted")
    with pytest.raises(InputError, match="expected a value for 'keep_brightest' of the method 'brightest'"):
        with_choice(Method.named("brightest"), small(), {LOOP_GAIN: 0.5})
