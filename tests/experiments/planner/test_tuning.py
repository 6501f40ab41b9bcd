import dataclasses
import itertools
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import numpy as np
import pytest
from tests.experiments.planner_cases import CAMERA, QUICK, answered
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.experiments import Question, tune
from faintspot.experiments.methods import method_for_scene
from faintspot.experiments.planner.question import SPOTS_PER_FRAME, Recorded, SimulatedSpots
from faintspot.experiments.planner.tuning import _bound, _error_scale, _ranked
from faintspot.slopes.estimators import Estimator, Scene, estimators, registry


def test_every_method_is_scored_on_the_same_spots() -> None:
    """The bound is for unbiased estimators; 512 spots tell R to 3 %."""
    answer = answered()
    assert [result.method.name for result in answer.results] == list(estimators())
    assert answer.curve.methods == tuple(estimators())
    assert (len(answer.flux_e), answer.realisations) == (3, 512)
    np.testing.assert_allclose(np.diff(np.log10(answer.flux_e)), 0.4 * 0.75)  # magnitudes
    assert all(result.settings.search_range_px == 1.0 for result in answer.results)
    assert np.all(np.diff(answer.curve.error, axis=0) < 0)
    assert answer["ml"].statistics.error.value == pytest.approx(answer.bound_px[1], rel=0.15)
    assert answer.best.method.name in ("ml", "weighted", "smoothed", "map")
    assert answer.best.over_brightest.value > 0.1


def test_the_bound_is_the_mean_over_sub_apertures_that_differ_in_flux() -> None:
    question = Question(**CAMERA)
    shared = dataclasses.replace(question, recorded=Recorded(relative_flux=np.repeat([0.5, 1.5], 50)))
    of_half, whole, of_more = (_bound(question, np.array([flux]))[0] for flux in (100.0, 200.0, 300.0))
    # Nine quantiles: four or five of each half, or one between them.
    assert _bound(shared, np.array([200.0]))[0] == pytest.approx((of_half + of_more) / 2, rel=0.06)
    assert of_half > 1.4 * whole


def test_stated_errors_are_scaled_to_the_actual_ones() -> None:
    rng = np.random.default_rng(3)
    truth, errors = rng.uniform(-1, 1, (4000, 2)), 0.2 * rng.standard_normal((4000, 2))
    errors[::50] = 5.0  # outliers, which no standard error tells
    stated = np.full(4000, 0.1)
    x, y = (truth + errors).T
    slopes: Any = SimpleNamespace(x=x, y=y, standard_error_x=stated, standard_error_y=stated)
    assert _error_scale(slopes, truth) == pytest.approx(2.0, rel=0.03)
    slopes.standard_error_x = slopes.standard_error_y = 2.04 * stated
    assert _error_scale(slopes, truth) == 1.0  # nearly right


def test_spots_are_exposed_and_measured_in_photo_electrons() -> None:
    """EM gain and background are the camera's; values tried together are each measured as one alone."""
    camera = {**CAMERA, "read_noise_e": 60.0, "em_gain": 20.0, "background_e": 2.0}
    question = Question(**camera, recorded=Recorded(relative_flux=np.array([0.5, 1.5])))
    spots = SimulatedSpots.of(question, 256, np.random.default_rng(1))
    _, scored = spots.exposed(300.0, np.random.default_rng(2))
    assert scored.truth.shape == (4, SPOTS_PER_FRAME, 2)
    assert np.abs(scored.truth).max() == pytest.approx(1.0, rel=0.02)
    electrons = (scored.frames.reshape(256, -1) / 20.0 - 2.0).sum(axis=1)
    # Windows of 144 px: an error of 40 e- in 256, and wings beyond the window.
    assert electrons.mean() == pytest.approx(300.0, abs=15.0)
    assert electrons.std() == pytest.approx(np.hypot(150.0, 50.0), rel=0.1)
    method = method_for_scene(estimators()["brightest"], question.scene(300.0))
    slopes = spots.measure(scored, method)
    assert np.abs(np.stack([slopes.x, slopes.y], axis=-1) - scored.truth).mean() < 0.3
    values = [10, 30]
    found: Any = spots.measure_each(scored, method, "keep_brightest", values)
    for value, (x, y) in zip(values, found, strict=True):
        alone = spots.measure(scored, method.with_options({"keep_brightest": value}))
        np.testing.assert_allclose(x, alone.x, atol=1e-6)
        np.testing.assert_allclose(y, alone.y, atol=1e-6)


@pytest.mark.slow
def test_tv_is_not_recommended_for_gaussian_spots_without_read_noise() -> None:
    answer = answered(read_noise_e=0.1, profile="gaussian", fwhm_px=2.0, flux_e=100.0)
    assert answer.best.method.name != "tv"
    # Every method has chosen its settings on 256 spots only.
    assert abs(answer["tv"].over_brightest.value) < 0.1


@pytest.mark.slow
def test_speckled_spots_are_measured_without_trusting_their_mean() -> None:
    optics = {"subaperture_m": 0.6, "wavelength_nm": 650.0, "pixel_scale_arcsec": 0.112, "r0_m": 0.15}
    answer = answered(fwhm_px=None, flux_e=500.0, **optics)
    assert answer.question.spots.d_over_r0 > 2
    # What is blurred or allowed to be wrong is nearer to the truth than the sharp PSF.
    assert answer["ml"].settings.model_error > 0 or answer["ml"].settings.blur_px > 0
    assert answer.best.statistics.corrected_rms.value < answer["brightest"].statistics.corrected_rms.value


@pytest.mark.slow
def test_the_same_seed_gives_the_same_answer() -> None:
    seen: list[tuple[int, int]] = []
    rng = np.random.default_rng(1)
    again = tune(Question(**CAMERA), rng=rng, progress=lambda *counts: seen.append(counts), **QUICK)
    assert [result.settings for result in again.results] == [each.settings for each in answered().results]
    np.testing.assert_array_equal(again.curve.error, answered().curve.error)
    assert again.equal == answered().equal
    assert seen[-1][0] == seen[-1][1]
    assert all(a[0] < b[0] for a, b in itertools.pairwise(seen))


def test_of_equal_methods_the_one_that_knows_least_then_the_cheapest_is_taken() -> None:
    rng, results = np.random.default_rng(2), []
    common = rng.normal(-2.0, 0.1, 16)
    blocks = {result.method.name: common + 1.0 for result in answered().results}
    for name in ("map", "ml", "tv", "smoothed"):
        blocks[name] = common + rng.normal(0.0, 0.01, 16)
    for result in answered().results:
        statistics = result.statistics
        rms = math.exp(float(blocks[result.method.name].mean()))
        made = dataclasses.replace(
            statistics, corrected_rms=dataclasses.replace(statistics.corrected_rms, value=rms)
        )
        results.append(dataclasses.replace(result, statistics=made))
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
    with refused("question"):
        tune({"read_noise_e": 3.0})  # type: ignore[arg-type]
    with refused("realisations"):
        tune(Question(**CAMERA), realisations=3)


@pytest.mark.slow
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
