from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import small

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, default_methods, method_kind
from faintspot.loop.simulation.simulation import simulate_loop
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimators

NAMES = (*estimators(), "ml_weighted", "map_predicted_weighted", "tv_uncorrected")


def first_choice(name: str) -> dict[str, Any]:
    return {key: each.first[-1] for key, each in method_kind(name).tuned(BRIGHT).items()} | {LOOP_GAIN: 0.2}


BRIGHT = small().replace("camera", photons_per_subaperture=1000.0)


@pytest.mark.parametrize("name", NAMES)
def test_every_method_closes_the_loop(name: str) -> None:
    """Not for long and not well, but better than no correction: Strehl ratio 0.17 then."""
    kind = method_kind(name)
    record = simulate_loop(BRIGHT, [kind.method(BRIGHT, first_choice(name))])
    assert record.labels == (kind.label,)
    assert np.isfinite(record.slopes_px).all()
    assert record.mean_strehl() > 0.35


def test_names_say_what_the_loop_does() -> None:
    for name in NAMES:
        assert method_kind(name).name == name
    assert method_kind("map_weighted_predicted").name == "map_predicted_weighted"
    method = method_kind("map_predicted_weighted").method(BRIGHT, first_choice("map_predicted_weighted"))
    assert method.predict_prior
    assert method.weighted_reconstructor
    assert not method.correct_gain
    assert method_kind("weighted").variants == ()
    assert len({method_kind(name).label for name in NAMES}) == len(NAMES)


def test_defaults_suit_the_configuration() -> None:
    usual = default_methods(small())
    assert set(estimators()) <= set(usual)
    assert {"ml_weighted", "map_predicted", "map_predicted_weighted"} <= set(usual)
    assert not any(name.endswith("_uncorrected") for name in usual)
    assert "tv_uncorrected" in default_methods(small().replace("control", mode="open"))


def test_an_estimator_of_ones_own_is_an_method(
    own_estimator: type[Estimator], monkeypatch: pytest.MonkeyPatch
) -> None:
    powers = [2.0, 1.5, 3.0, 4.0, 5.0]
    monkeypatch.setattr(own_estimator, "tuned", lambda self, scene: {"power": powers})
    assert "own" in default_methods(small())
    kind = method_kind("own_uncorrected")
    tuned = kind.tuned(BRIGHT)
    # Two steps beyond each end, as far as the option goes.
    assert tuned["power"].values == pytest.approx((1.125, 1.5, 2.0, 3.0, 4.0, 5.0, 6.25, 7.8125))
    assert tuned["power"].first == pytest.approx((1.5, 4.0, 6.25))
    record = simulate_loop(BRIGHT, [kind.method(BRIGHT, {LOOP_GAIN: 0.3, "power": 2.0})])
    assert record.mean_strehl() > 0.35


@pytest.mark.parametrize("name", NAMES)
def test_first_values_are_among_all(name: str) -> None:
    for each in method_kind(name).tuned(small()).values():
        assert set(each.first) <= set(each.values)
        assert list(each.values) == sorted(set(each.values))


def test_unknown_methods_and_missing_values() -> None:
    with pytest.raises(InputError, match=r"^method = 'kog': expected one of 'brightest'"):
        method_kind("kog")
    with pytest.raises(InputError, match="method = 'tv_predicted': expected an estimator that takes a prior"):
        method_kind("tv_predicted")
    with pytest.raises(InputError, match="expected a value for 'keep_brightest' of the method 'brightest'"):
        method_kind("brightest").method(small(), {LOOP_GAIN: 0.5})
