import copy
import pickle
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumLikelihood
from faintspot.slopes.pipeline.settings import option_names


class TestSettings:
    def test_scalars_become_plain(self) -> None:
        settings = fs.Settings(noise_std=np.float32(0.5), keep_brightest=np.int8(7))
        assert type(settings.noise_std) is float
        assert type(settings.keep_brightest) is int
        assert settings == fs.Settings(noise_std=0.5, keep_brightest=7)
        assert settings != fs.Settings(noise_std=0.5, keep_brightest=8)
        assert settings != 0.5

    def test_settings_are_immutable(self) -> None:
        settings = fs.Settings(noise_std=1.0)
        with pytest.raises(AttributeError, match=r"settings\.replace\(algorithm="):
            settings.algorithm = "chambolle"
        with pytest.raises(AttributeError, match="algorithm"):
            settings.estimator.algorithm = "chambolle"  # type: ignore[attr-defined]

    def test_defaults_follow_window_and_preset(self) -> None:
        settings = fs.Settings(noise_std=1.0)
        assert settings.values("keep_brightest", 3, 256).tolist() == [20] * 3
        assert settings.values("keep_brightest", 1, 16).tolist() == [5]
        assert settings.values("tolerance", 2, 16).tolist() == [0.0, 0.0]
        assert settings.values("max_iterations", 2, 16).tolist() == [24, 24]
        fast = settings.replace(preset="fast")
        assert fast.values("tolerance", 2, 16).tolist() == [0.0, 0.0]
        assert fast.values("max_iterations", 2, 16).tolist() == [8, 8]
        assert fast.replace(max_iterations=5).values("max_iterations", 1, 16).tolist() == [5]
        assert fs.Settings("brightest").values("keep_brightest", 2, 16).tolist() == [5, 5]

    def test_iterations_follow_the_number_of_pixels_kept(self) -> None:
        settings = fs.Settings(noise_std=1.0, keep_brightest=[32, 33])
        assert settings.values("tolerance", 2, 256).tolist() == [0.0, 0.0025]
        assert settings.values("max_iterations", 2, 256).tolist() == [24, 480]
        stated = settings.replace(where=[0], tolerance=0.01)
        assert stated.values("tolerance", 2, 256).tolist() == [0.01, 0.0025]
        assert stated.values("max_iterations", 2, 256).tolist() == [480, 480]


class TestReplace:
    base = fs.Settings(noise_std=1.0, keep_brightest=10)

    def test_without_a_place_all_subapertures_change(self) -> None:
        changed = self.base.replace(noise_std=2.0, algorithm="chambolle")
        assert changed == fs.Settings(noise_std=2.0, keep_brightest=10, algorithm="chambolle")
        assert self.base.noise_std == 1.0

    def test_again_and_again(self) -> None:
        changed = self.base.replace(where=[0, 1], noise_std=2.0).replace(where=[1, 2], noise_std=3.0)
        assert changed.values("noise_std", 4, 16).tolist() == [2, 3, 3, 1]
        assert changed.replace(noise_std=5.0).noise_std == 5.0

    def test_default_that_depends_on_the_window(self) -> None:
        changed = fs.Settings(noise_std=1.0).replace(where=1, keep_brightest=3)
        assert changed.values("keep_brightest", 3, 256).tolist() == [20, 3, 20]

    @pytest.mark.parametrize(
        ("words", "where", "changes"),
        [
            ("noise_sd: unknown option of 'tv'; did you mean noise_std?", None, {"noise_sd": 1.0}),
            ("threshold_e: an option of 'thresholded', not of 'tv'", None, {"threshold_e": 1.0}),
            ("estimator", [0], {"estimator": "ml"}),
            ("algorithm", [0], {"algorithm": "chambolle"}),
            ("keep_brightest: expected a value", [0], {"keep_brightest": None}),
        ],
    )
    def test_bad_changes_are_refused(self, words: str, where: Any, changes: dict[str, Any]) -> None:
        with refused(words):
            self.base.replace(where=where, **changes)

    def test_beyond_the_sensor(self) -> None:
        with refused("where", "sub-aperture 3 does not exist; there are 3"):
            fs.Settings(noise_std=[1, 2, 3]).replace(where=3, noise_std=1.0)
        with refused("noise_std", "sub-aperture 7 does not exist; there are 5"):
            self.base.replace(where=7, noise_std=2.0).values("noise_std", 5, 16)


class TestEstimators:
    def test_a_name_or_an_object(self) -> None:
        by_name = fs.Settings("ml", model_error=0.2, search_range_px=2.0)
        made = MaximumLikelihood(model_error=0.2)
        by_object = fs.Settings(made, search_range_px=2.0)
        assert by_object == by_name
        assert by_object.estimator is made
        assert by_name.estimator.name == "ml"
        assert by_name.model_error == 0.2
        assert repr(by_name) == "Settings('ml', model_error=0.2, search_range_px=2.0)"

    def test_options_are_those_of_the_estimator_and_the_shared_ones(self) -> None:
        settings = fs.Settings("thresholded", threshold_e=3.0)
        assert set(settings.declared()) == {"threshold_e", "flux_floor", *fs.Settings.SHARED}
        assert settings.chosen() == {"threshold_e": 3.0}
        with pytest.raises(AttributeError, match=r"no option 'noise_std'; there are .*threshold_e"):
            _ = settings.noise_std
        assert set(option_names()) > {"estimator", "noise_std", "threshold_e", "flux_e"}

    @pytest.mark.parametrize(
        ("words", "estimator", "options"),
        [
            ("model_error: an option of 'ml' and 'map', not of 'weighted'", "weighted", {"model_error": 0.1}),
            ("modle_error: unknown option of 'ml'; did you mean model_error?", "ml", {"modle_error": 0.1}),
            ("model_error: give it to the estimator's own object", MaximumLikelihood(), {"model_error": 0.2}),
            ("noise_std: expected a number (electrons)", "tv", {}),
            ("preset = 'slow': expected", "tv", {"noise_std": 1.0, "preset": "slow"}),
            (
                "arrays of one length, got model_error 2, flux_e 3",
                "ml",
                {"model_error": [0.1, 0.2], "flux_e": [1.0, 2.0, 3.0]},
            ),
            (
                "arrays of one length, got keep_brightest 3, noise_std 2",
                "tv",
                {"noise_std": [1, 2], "keep_brightest": [1, 2, 3]},
            ),
        ],
    )
    def test_what_is_refused(self, words: str, estimator: Any, options: dict[str, Any]) -> None:
        with refused(words):
            fs.Settings(estimator, **options)

    def test_another_estimator_keeps_what_it_has_too(self) -> None:
        tv = fs.Settings("tv", noise_std=2.0, keep_brightest=9, search_range_px=3.0, flux_e=[1.0, 2.0])
        smoothed = tv.replace(estimator="smoothed", smoothing_px=0.8)
        assert smoothed == fs.Settings(
            "smoothed", keep_brightest=9, smoothing_px=0.8, search_range_px=3.0, flux_e=[1.0, 2.0]
        )
        ml = tv.replace(estimator=MaximumLikelihood(model_error=0.3))
        assert ml == fs.Settings("ml", model_error=0.3, search_range_px=3.0, flux_e=[1.0, 2.0])
        with refused("noise_std: an option of 'tv', not of 'smoothed'"):
            tv.replace(estimator="smoothed", noise_std=2.0)
        with refused("noise_std: expected a number (electrons)", 'estimator = "brightest"'):
            smoothed.replace(estimator="tv")

    def test_copies_and_other_processes(self) -> None:
        settings = fs.Settings("ml", model_error=[0.1, 0.2], flux_e=50.0)
        assert copy.deepcopy(settings) == settings
        assert pickle.loads(pickle.dumps(settings)) == settings
