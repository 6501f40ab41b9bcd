"""Methods: estimators made for a scene, by their own word."""

from collections.abc import Sequence

import numpy as np
import pytest

from faintspot import PSF
from faintspot.experiments.methods import (
    Choice,
    Knowledge,
    coordinate_search,
    corrected_badness,
    method_for_scene,
    tuned_options,
)
from faintspot.slopes.estimators import Scene, estimators

SCENE = Scene(flux_e=123.456, read_noise_e=3.0, window=(12, 12), spot_fwhm_px=1.77, position_range_px=1.0)
WITHOUT_OPTIONS = ("centroid",)


@pytest.mark.parametrize("name", list(estimators()))
def test_every_estimator_is_made_for_a_scene(name: str) -> None:
    kind = estimators()[name]
    method = method_for_scene(kind, SCENE, psf=PSF.analytic())
    assert (method.name, method.label) == (name, kind.label)
    assert method.settings.search_range_px == 1.0
    assert (method.psf is None) == (Knowledge.of(method.estimator) < Knowledge.SPOT)
    options = tuned_options(method, SCENE)
    for option, values in options.items():
        changed = method.with_options({option: values[-1]})
        assert getattr(changed.settings, option) == values[-1]
        assert all(float(f"{value:.3g}") == value for value in values if isinstance(value, float))
    assert not any(isinstance(value, str) and value == "auto" for value in method.settings.chosen().values())


def test_knowledge_follows_from_the_needs() -> None:
    found = {name: Knowledge.of(kind) for name, kind in estimators().items()}
    assert [name for name, knowledge in found.items() if knowledge is Knowledge.SPOT] == [
        "ml",
        "map",
    ]
    assert [name for name, knowledge in found.items() if knowledge is Knowledge.WIDTH] == [
        "window",
        "weighted",
    ]


def test_speckled_spots_are_blurred_or_doubted() -> None:
    speckled = Scene(**{**vars(SCENE), "d_over_r0": 2.0})
    method = method_for_scene(estimators()["ml"], speckled)
    assert set(tuned_options(method, speckled)) == {"blur_px", "model_error"}
    assert tuned_options(method, SCENE) == {}


def test_choice_follows_the_axes_to_the_minimum() -> None:
    axes = {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]}

    def badness(choice: Choice, name: str, values: Sequence[float]) -> list[float]:
        each = [{**choice, name: value} for value in values]
        return [(one["a"] - 2) ** 2 + 0.1 * (one["b"] - one["a"]) ** 2 for one in each]

    assert coordinate_search(axes, badness) == {"a": 2.0, "b": 2.0}


def test_one_axis_is_looked_at_once_and_none_not_at_all() -> None:
    looks = []

    def badness(choice: Choice, name: str, values: Sequence[str]) -> list[float]:
        looks.append(name)
        return [3.0, 1.0, 2.0]

    assert coordinate_search({"rule": ["x", "y", "z"]}, badness) == {"rule": "y"}
    assert coordinate_search({}, badness) == {}
    assert looks == ["rule"]


def test_what_measures_nothing_is_behind_all_that_measures_something() -> None:
    truth = np.random.default_rng(1).uniform(-1, 1, (200, 2))
    noise = np.random.default_rng(2).normal(0, 3, (2, 200))
    nothing = corrected_badness(np.zeros(200), np.zeros(200), truth)
    assert nothing > 1e5
    assert corrected_badness(truth[:, 0] + noise[0], truth[:, 1] + noise[1], truth) < 1e3
    half = corrected_badness(0.5 * truth[:, 0], 0.5 * truth[:, 1], truth)
    assert half == pytest.approx(0.0, abs=1e-7)
