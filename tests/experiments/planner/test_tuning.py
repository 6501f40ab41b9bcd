import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import pytest
from tests.experiments.planner_cases import CAMERA, QUICK, answered

from faintspot.base.errors import InputError
from faintspot.experiments import Question, tune
from faintspot.experiments.planner.tuning import _ranked
from faintspot.slopes.estimators import Estimator, Scene, estimators, registry


def test_every_method_is_scored_on_the_same_spots() -> None:
    answer = answered()
    assert [result.method.name for result in answer.results] == list(estimators())
    assert answer.curve.methods == tuple(estimators())
    assert (len(answer.flux_e), answer.realisations) == (3, 512)
    assert all(result.settings.search_range_px == 1.0 for result in answer.results)


def test_errors_are_near_the_bound_where_the_spot_is_known() -> None:
    """The bound is for unbiased estimators; 512 spots tell R to 3 %."""
    answer = answered()
    assert answer["ml"].statistics.error.value == pytest.approx(answer.bound_px[1], rel=0.15)
    assert answer.best.method.name in ("ml", "weighted", "matched", "smoothed", "map")
    assert answer.best.over_brightest.value > 0.1


def test_more_flux_means_smaller_errors() -> None:
    for result in answered().results:
        assert np.all(np.diff(result.error_px) < 0)


def test_tv_is_not_recommended_for_gaussian_spots_without_read_noise() -> None:
    answer = answered(read_noise_e=0.1, profile="gaussian", fwhm_px=2.0, flux_e=100.0)
    assert answer.best.method.name != "tv"
    # Every method has chosen its settings on 256 spots only.
    assert abs(answer["tv"].over_brightest.value) < 0.1


def test_speckled_spots_are_measured_without_trusting_their_mean() -> None:
    answer = answered(
        fwhm_px=None,
        subaperture_m=0.6,
        wavelength_nm=650.0,
        pixel_scale_arcsec=0.112,
        r0_m=0.15,
        flux_e=500.0,
    )
    assert answer.question.d_over_r0 > 2
    # What is blurred or allowed to be wrong is nearer to the truth than the sharp PSF.
    assert answer["ml"].settings.model_error > 0 or answer["ml"].settings.blur_px > 0
    assert answer.best.statistics.corrected_rms.value < answer["brightest"].statistics.corrected_rms.value


def test_the_same_seed_gives_the_same_answer() -> None:
    again = tune(Question(**CAMERA), rng=np.random.default_rng(1), **QUICK)
    for first, second in zip(answered().results, again.results, strict=True):
        assert first.settings == second.settings
        np.testing.assert_array_equal(first.error_px, second.error_px)
    assert again.equal == answered().equal


def test_progress_is_reported_to_the_end() -> None:
    seen: list[tuple[int, int]] = []
    question = Question(**{**CAMERA, "pixels": 8})
    tune(question, realisations=256, steps=1, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1]
    assert all(a[0] < b[0] for a, b in itertools.pairwise(seen))


def test_of_equal_methods_the_one_that_knows_least_then_the_cheapest_is_taken() -> None:
    results = list(answered().results)
    rng = np.random.default_rng(2)
    common = rng.normal(-2.0, 0.1, 16)
    blocks = {result.method.name: common + 1.0 for result in results}
    for name in ("map", "ml", "tv", "smoothed"):
        blocks[name] = common + rng.normal(0.0, 0.01, 16)
    rms = {name: math.exp(float(values.mean())) for name, values in blocks.items()}
    results = [
        dataclasses.replace(
            result,
            statistics=dataclasses.replace(
                result.statistics,
                corrected_rms=dataclasses.replace(
                    result.statistics.corrected_rms, value=rms[result.method.name]
                ),
            ),
        )
        for result in results
    ]
    assert _ranked(results, blocks, {}) == ("smoothed", "tv", "ml", "map")
    # The recording has larger errors of one of them than the simulation.
    assert _ranked(results, blocks, {"smoothed": 1.3, "ml": 1.0}) == ("tv", "ml", "map")


@pytest.mark.usefixtures("own_estimator")
def test_an_estimator_of_somebody_else_takes_part() -> None:
    answer = tune(Question(**{**CAMERA, "flux_e": 2000.0}), realisations=256, steps=1)
    assert answer["own"].settings.power == 2.0
    assert answer["own"].statistics.error.value < answer["centroid"].statistics.error.value
    assert answer["own"].method.label == "somebody's own"


def test_only_a_question_is_answered() -> None:
    with pytest.raises(InputError, match="question"):
        tune({"read_noise_e": 3.0})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="realisations"):
        tune(Question(**CAMERA), realisations=3)


def test_a_plugin_that_refuses_the_scene_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True, eq=False, kw_only=True)
    class Refusing(Estimator):
        name: ClassVar[str] = "refusing"
        label: ClassVar[str] = "refusing"
        method: ClassVar[str] = "none"

        def for_scene(self, scene: Scene) -> Self:
            raise InputError("scene: too bright for me")

    monkeypatch.setattr(registry, "_kinds", {**estimators(), "refusing": Refusing})
    answer = tune(Question(**CAMERA), rng=np.random.default_rng(1), **QUICK)
    assert "too bright for me" in answer.left_out["refusing"]
    assert "refusing" not in [result.method.name for result in answer.results]
