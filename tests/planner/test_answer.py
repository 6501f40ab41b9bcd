from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.planner.planner_cases import answered

from faintspot import Calibration, Layout, Settings, SlopePipeline
from faintspot.planner import wording
from faintspot.planner.answer import Answer
from faintspot.planner.arms import ARMS
from faintspot.simulate import Detector, sensor_frames
from faintspot.study.metric import Estimate, slope_error

LAYOUT = Layout.grid((4, 4), pixels=12)


def with_layout(answer: Answer, name: str) -> Answer:
    question = dataclasses.replace(answer.question, layout=LAYOUT)
    return dataclasses.replace(answer, question=question, equal=(name,))


@pytest.mark.parametrize("name", [arm.name for arm in ARMS])
def test_the_configuration_gives_the_error_that_was_promised(name: str, tmp_path: Path) -> None:
    answer = with_layout(answered(), name)
    answer.save(tmp_path / "faintspot.toml")
    pipeline = SlopePipeline.from_file(tmp_path / "faintspot.toml")
    frames, truth = sensor_frames(
        LAYOUT.corners,
        LAYOUT.window,
        LAYOUT.frame_shape,
        64,
        flux_e=200.0,
        detector=Detector(read_noise_e=3.0),
        rng=np.random.default_rng(8),
    )
    slopes = pipeline(frames)
    found = slope_error(slopes.x, slopes.y, truth)
    # Two samples of 512 and 1024 spots: 3 % and 2 %.
    assert found.value == pytest.approx(answer[name].statistics.error.value, rel=0.15)


def test_tables_survive_a_layout_that_comes_later(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    answered().save(path)
    LAYOUT.save(path)
    pipeline = SlopePipeline.from_file(path)
    assert pipeline.settings == answered().best.settings
    assert pipeline.calibration.read_noise_e == 3.0


def test_maps_of_the_calibration_are_kept() -> None:
    answer = answered()
    dark = np.full((4, 4), 7.0)
    question = dataclasses.replace(answer.question, calibration=Calibration(dark=dark), gain_e_per_adu=2.0)
    calibration = dataclasses.replace(answer, question=question).calibration
    np.testing.assert_array_equal(calibration.dark, dark)
    assert (calibration.gain_e_per_adu, calibration.read_noise_e) == (2.0, 3.0)


def test_magnitudes_are_relative_without_photometry() -> None:
    answer = answered()
    assert answer.magnitudes([200.0, 100.0]) == pytest.approx([0.0, 0.7526], abs=1e-4)
    assert "fainter" in answer.magnitude_label


def test_the_recommendation_in_words() -> None:
    answer = with_layout(answered(budget="0.1"), "ml")
    lines = wording.recommendation(answer)
    assert lines[0].startswith('Recommended: maximum likelihood (estimator "ml"')
    text = " ".join(lines)
    assert "over brightest pixels" in text
    assert "TV denoising" in text
    assert "need not know" in text
    assert "limiting flux for R = 0.1 px" in text
    assert "assumed profile" in " ".join(wording.foundations(answer))


def test_a_star_that_is_too_faint_is_called_so() -> None:
    answer = answered(read_noise_e=30.0, flux_e=20.0)
    assert answer.is_hopeless
    assert "too faint" in " ".join(wording.recommendation(answer))


def test_gains_beyond_the_range_are_said_to_be_so() -> None:
    answer = answered()
    beyond = Estimate(float("inf"), float("nan"))
    assert wording.gain_in_words(answer, beyond) == "more than 0.8 mag"
    assert wording.short_gain(answer, Estimate(-float("inf"), float("nan"))) == "<-0.8"
    assert wording.short_gain(answer, Estimate(0.12345, 0.0123)) == "+0.12±0.01"


def test_settings_in_words_name_what_matters() -> None:
    tv = wording.settings_in_words(Settings(noise_std=1.5, keep_brightest=12, max_iterations=25))
    assert tv == 'estimator "cog", noise_std 1.5, max_iterations 25, keep_brightest 12'
    fast = wording.settings_in_words(Settings(noise_std=1.5, keep_brightest=12, preset="fast"))
    assert fast == 'estimator "cog", preset "fast", noise_std 1.5, keep_brightest 12'
    plain = wording.settings_in_words(Settings(denoise=False, keep_brightest=9))
    assert plain == 'estimator "cog", denoise false, keep_brightest 9'


def test_the_figure_shows_every_arm_and_the_limit() -> None:
    answer = answered(budget="0.1")
    axes = answer.figure().axes[0]
    labels = axes.get_legend_handles_labels()[1]
    assert len(labels) == len(answer.results) + 2  # the bound, and no estimate at all
    assert any("recommended" in label for label in labels)
    assert any("limit" in text.get_text() for text in axes.texts)
