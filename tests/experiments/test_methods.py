"""Methods: estimators made for a scene, by their own word."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from faintspot import PSF
from faintspot.experiments.methods import (
    Choice,
    Knowledge,
    coordinate_search,
    corrected_badness,
    keeps_every_k,
    knows_the_spot,
    label_of,
    method_for_scene,
    style_of,
    tuned_options,
)
from faintspot.slopes.estimators import Estimator, Scene, estimators

SCENE = Scene(flux_e=123.456, read_noise_e=3.0, window=(12, 12), spot_fwhm_px=1.77, position_range_px=1.0)


def test_every_estimator_is_made_for_a_scene() -> None:
    knowledge = {name: Knowledge.of(kind) for name, kind in estimators().items()}
    assert [name for name, known in knowledge.items() if known is Knowledge.SPOT] == ["ml", "map"]
    assert [name for name, known in knowledge.items() if known is Knowledge.WIDTH] == ["window", "weighted"]
    for name, kind in estimators().items():
        method = method_for_scene(kind, SCENE, psf=PSF.analytic())
        assert (method.name, method.label) == (name, kind.label)
        assert method.settings.search_range_px == 1.0
        assert (method.psf is None) == (Knowledge.of(method.estimator) < Knowledge.SPOT)
        for option, values in tuned_options(method, SCENE).items():
            changed = method.with_options({option: values[-1]})
            assert getattr(changed.settings, option) == values[-1]
            assert all(float(f"{value:.3g}") == value for value in values if isinstance(value, float))
        assert "auto" not in [value for value in method.settings.chosen().values() if isinstance(value, str)]


def test_speckled_spots_are_blurred_or_doubted() -> None:
    speckled = Scene(**{**vars(SCENE), "d_over_r0": 2.0})
    method = method_for_scene(estimators()["ml"], speckled)
    assert set(tuned_options(method, speckled)) == {"blur_px", "model_error"}
    assert tuned_options(method, SCENE) == {}


def test_choice_follows_the_axes_to_the_minimum() -> None:
    """One axis is looked at once, and none not at all."""
    axes, looks = {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]}, []

    def badness(choice: Choice, name: str, values: Sequence[Any]) -> list[float]:
        looks.append(name)
        if name == "rule":
            return [3.0, 1.0, 2.0]
        each = [{**choice, name: value} for value in values]
        return [(one["a"] - 2) ** 2 + 0.1 * (one["b"] - one["a"]) ** 2 for one in each]

    assert coordinate_search(axes, badness) == {"a": 2.0, "b": 2.0}
    looks.clear()
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


def test_methods_of_other_installations_have_a_name_and_a_style() -> None:
    assert label_of("of another installation") == "of another installation"
    assert style_of("of another installation") == Estimator.style
    assert [knows_the_spot(method) for method in ("brightest", "weighted", "ml", "nobody's")] == [0, 1, 1, 0]
    assert [keeps_every_k(estimators()[method]) for method in ("tv", "thresholded")] == [True, False]
