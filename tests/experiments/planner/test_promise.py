"""What tune promises, against frames with a known truth."""

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.planner_cases import QUICK

from faintspot.base.statistics import Estimate
from faintspot.experiments import Answer, Promise, Question, question_from_frames, tune
from faintspot.experiments.planner.promise import (
    _dealt,
    _error_of,
    _frame_to_frame,
    _split,
    _spot_positions,
    _with_unshared,
)
from faintspot.experiments.planner.text import CONTRADICTED, promise_lines
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.psf_learning import LearntPSF

LAYOUT = Layout.grid((6, 6), pixels=12)


def answered(movement_px: float, gain: float, **given: float) -> Answer:
    """Return the answer to frames whose spots move, at 300 e- with 3 e- of read noise and a background."""
    rng = np.random.default_rng(5)
    camera = Detector(read_noise_e=3.0, gain_e_per_adu=gain, offset_adu=100.0, background_e=3.0)
    positions = rng.uniform(-0.5, 0.5, (36, 2)) + movement_px * rng.standard_normal((40, 36, 2))
    frames, _ = sensor_frames(LAYOUT, 40, flux_e=300.0, positions=positions, detector=camera, rng=rng)
    return tune(question_from_frames(frames, layout=LAYOUT, **given), **QUICK)


@pytest.mark.slow
def test_without_darks_the_flux_is_right_and_the_promise_kept(tmp_path: Path) -> None:
    answer = answered(0.7, 0.5)
    question, promise = answer.question, answer.promise
    assert question.star_flux_e == pytest.approx(300.0, rel=0.06)  # as the gain
    assert any("fitting spots and background" in fact for fact in question.recorded.facts)
    # 99 % of normal movement of 0.7 px about places within 0.5 px lie within 1.9 px; then the margin.
    assert question.spots.search_range_px == pytest.approx(1.15 * 1.9, rel=0.15)
    assert promise is not None
    assert not promise.contradicted
    assert promise.ratio.value == pytest.approx(1.0, abs=0.1)  # 720 pairs: 3 % each
    assert promise.frame_to_frame.value > 3 * promise.measured.value
    answer.save(tmp_path / "faintspot.toml")
    table = tomllib.loads((tmp_path / "faintspot.toml").read_text())["promise"]
    assert table["contradicted"] is False
    assert table["measured_px"] == pytest.approx(promise.measured.value, rel=0.01)
    assert len(promise_lines(answer)) == 1


@pytest.mark.slow
def test_a_promise_that_rests_on_a_wrong_gain_is_contradicted() -> None:
    answer = answered(0.7, 0.5, gain_e_per_adu=1.0)
    assert answer.promise is not None
    assert answer.promise.contradicted
    # The photons' part of the noise is sqrt(2) times what was taken, the read noise is right in ADU.
    assert answer.promise.noise_differs
    assert 1.1 < answer.promise.noise_ratio < 1.42
    assert promise_lines(answer)[-1].startswith(CONTRADICTED)


def test_errors_decide_what_contradicts() -> None:
    def promise(measured: float, error: float, frame_to_frame: float = 9.0) -> Promise:
        return Promise(
            100.0, Estimate(0.1, 0.001), Estimate(measured, error), Estimate(frame_to_frame, 0.0), 1.0, 0.07
        )

    assert not promise(0.12, 0.01).contradicted
    assert promise(0.13, 0.005).contradicted
    assert promise(0.07, 0.005).contradicted
    assert promise(0.1, 0.01, frame_to_frame=0.08).contradicted
    assert promise(0.13, 0.005).expected_px == pytest.approx(0.091)
    # Errors that the images compared share are not seen: less than predicted does not lower the promise.
    assert promise(0.07, 0.005).expected_px == 0.07


def test_scatter_between_frames_that_one_method_alone_has_is_its_error() -> None:
    def checked(scatters: dict[str, float]) -> dict[str, Promise]:
        alike, known = Estimate(0.1, 0.001), {name: Estimate(s, 0.002) for name, s in scatters.items()}
        return _with_unshared(
            {name: Promise(100.0, alike, alike, scatter, 1.0, 0.07) for name, scatter in known.items()}
        )

    still = checked({"window": 0.11, "smoothed": 0.115, "ml": 0.3})
    assert still["window"].factor == still["smoothed"].factor == 1.0
    assert still["ml"].expected_px == pytest.approx(0.07 * 0.296 / 0.1, rel=0.01)
    moving = checked({"window": 0.5, "ml": 0.6})  # gains that differ would look the same
    assert moving["ml"].factor == 1.0
    assert checked({"window": math.nan})["window"].factor == 1.0


@pytest.mark.slow
def test_methods_are_chosen_by_the_recording() -> None:
    answer = answered(0.0, 0.5)
    assert set(answer.promises) == {result.method.name for result in answer.results}
    assert all(promise.unshared_px == 0 for promise in answer.promises.values())
    ratios = [promise.ratio.value for promise in answer.promises.values()]
    np.testing.assert_allclose(ratios, 1.0, atol=0.15)


@pytest.mark.slow
def test_spots_in_the_middle_of_the_search_range_have_larger_errors_than_spread_ones() -> None:
    """The range of 1 px cuts errors of spots near its edges: 0.25 px against 0.28 px at 0.36 px rms."""
    rng = np.random.default_rng(7)
    camera = Detector(read_noise_e=3.0, offset_adu=100.0)
    frames, truth = sensor_frames(LAYOUT, 80, flux_e=36.0, position_range_px=0.01, detector=camera, rng=rng)
    known: dict[str, Any] = {"gain_e_per_adu": 1.0, "read_noise_e": 3.0, "fwhm_px": 1.77}
    question = question_from_frames(frames[:40], layout=LAYOUT, search_range_px=1.0, **known)
    answer = tune(question, **QUICK)
    promise, method = answer.promises["ml"], answer["ml"].method
    assert promise.placed_px > 1.05 * promise.promised_px
    slopes = SlopePipeline(LAYOUT, method.settings, question.calibration, **method.parts)(frames[40:])
    reached = np.abs(np.stack([slopes.x, slopes.y], axis=-1) - truth[40:]).mean()
    assert promise.expected_px == pytest.approx(reached, rel=0.08)


def assert_independent(pair: tuple[np.ndarray, np.ndarray], mean: float, variance: float) -> None:
    """Of 200,000 pixels: mean and variance to 0.5 %, their correlation to 0.0025; four times that."""
    assert [image.mean() for image in pair] == pytest.approx([mean, mean], abs=0.01 * np.sqrt(variance))
    assert [image.var() for image in pair] == pytest.approx([variance, variance], rel=0.015)
    assert abs(np.corrcoef([image.ravel() for image in pair])[0, 1]) < 0.01


def test_two_images_of_a_frame_have_the_noise_of_their_flux_and_none_in_common() -> None:
    rng, shape, share = np.random.default_rng(1), (50, 4, 20, 50), 0.4
    expected = np.full(shape, 40.0)
    images = 40.0 + 7.0 * rng.standard_normal(shape)  # photons, and read noise of 3 electrons
    assert_independent(_split(images, expected, 9.0, 1.0, share, rng), 16.0, 16.0 + 9.0)
    question = Question(read_noise_e=0.2, background_e=5.0, flux_e=100.0, fwhm_px=1.77, layout=LAYOUT)
    counted = rng.poisson(45.0, shape).astype(np.float64) - 5.0
    assert_independent(_dealt(counted, share, question, rng), 16.0, 16.0 + 5.0 + 0.2**2)


def test_error_from_frame_to_frame_is_r_whatever_moves_slowly() -> None:
    """R of normal errors is sqrt(2 / pi) standard deviations; 2 x 12,000 slopes tell it to 0.6 %."""
    slopes = 0.2 * np.random.default_rng(2).standard_normal((400, 30, 2))
    found = _error_of(slopes[::2] - slopes[1::2], 2)
    assert found.value == pytest.approx(0.2 * np.sqrt(2 / np.pi), rel=0.03)
    assert found.standard_error == pytest.approx(0.2 * np.sqrt((1 - 2 / np.pi) / 12000), rel=0.05)
    moving = slopes + 0.3 * np.arange(400)[:, None, None]
    assert _frame_to_frame(moving).value == pytest.approx(0.2 * np.sqrt(2 / np.pi), rel=0.03)


def test_spots_are_predicted_without_the_noise_of_their_positions() -> None:
    known: dict[str, Any] = {"layout": LAYOUT, "fwhm_px": 1.77, "search_range_px": 2.0}
    question = Question(read_noise_e=3.0, flux_e=100.0, **known)
    positions = np.random.default_rng(5).normal(0.0, 0.5, (360, 2))

    def scatter(error_px: float) -> float:
        error, psf = np.full((360, 2), error_px), PSF.analytic(radius_px=8)
        fitted = LearntPSF(psf, np.zeros(1), positions, np.full(360, 100.0), error)
        return float(_spot_positions(question, fitted).std(axis=0).max())

    assert scatter(0.5) < 0.5 * scatter(0.01)
