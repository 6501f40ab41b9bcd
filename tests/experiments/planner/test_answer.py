import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.planner_cases import answered
from tests.patience import mostly_slow
from tests.refusals import refused

from faintspot import Calibration, Layout, SlopePipeline
from faintspot.base.statistics import slope_error
from faintspot.experiments.planner import text as answer_text
from faintspot.experiments.planner.answer import Answer
from faintspot.experiments.planner.text import tune_figure
from faintspot.slopes.estimators import estimators
from faintspot.slopes.simulate import Detector, sensor_frames

LAYOUT = Layout.grid((4, 4), pixels=12)


def with_layout(answer: Answer, name: str) -> Answer:
    question = dataclasses.replace(answer.question, layout=LAYOUT)
    return dataclasses.replace(answer, question=question, equal=(name,))


@pytest.mark.parametrize("name", mostly_slow(1, estimators()))
def test_the_configuration_gives_the_error_that_was_promised(name: str, tmp_path: Path) -> None:
    answer = with_layout(answered(), name)
    answer.save(tmp_path / "faintspot.toml")
    pipeline = SlopePipeline.from_file(tmp_path / "faintspot.toml")
    camera = Detector(read_noise_e=3.0)
    frames, truth = sensor_frames(LAYOUT, 64, flux_e=200.0, detector=camera, rng=np.random.default_rng(8))
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
    answer, dark = answered(), np.full((4, 4), 7.0)
    question = dataclasses.replace(answer.question, calibration=Calibration(dark=dark), gain_e_per_adu=2.0)
    emccd = dataclasses.replace(question, em_gain=30.0, background_e=0.7)
    plain, multiplied = (dataclasses.replace(answer, question=each).calibration for each in (question, emccd))
    np.testing.assert_array_equal(plain.dark, dark)
    assert (plain.gain_e_per_adu, plain.read_noise_e) == (2.0, 3.0)
    assert (multiplied.em_gain, multiplied.background_e) == (30.0, 0.7)


def test_magnitudes_are_relative_without_photometry() -> None:
    answer = answered()
    assert answer.magnitudes([200.0, 100.0]) == pytest.approx([0.0, 0.7526], abs=1e-4)
    assert "fainter" in answer.magnitude_label
    with refused("'tvs'", "brightest, tv"):
        answer["tvs"]


@pytest.mark.slow
def test_a_star_that_is_too_faint_is_called_so() -> None:
    answer = answered(read_noise_e=30.0, flux_e=20.0)
    assert answer.is_hopeless
    assert answer.prior_rms_px == pytest.approx(1 / np.sqrt(3))  # of places within 1 px
    assert "too faint" in " ".join(answer_text.recommendation(answer))


@pytest.mark.slow
def test_the_limit_is_sought_beyond_the_plot() -> None:
    answer = answered(budget="0.02")
    limit = answer.best.limiting_flux_e
    assert limit is not None
    assert 0 < limit.value < np.inf
    assert answer.flux_e[-1] > 10 ** (0.4 * 0.75) * 200 * 1.01
    assert answer.flux_e[answer.at_star] == pytest.approx(200.0)
    assert "all that was tried" not in " ".join(answer_text.recommendation(answer))
    # R of the recommended method at its limit is the budget: straight line in log-log between the points.
    error = answer.curve.of(answer.best.method.name)
    found = np.exp(np.interp(np.log(limit.value), np.log(answer.flux_e), np.log(error)))
    assert found == pytest.approx(0.02, rel=0.05)


def test_the_figure_shows_every_method_and_the_limit() -> None:
    answer = answered(budget="0.1")
    axes = tune_figure(answer).axes[0]
    labels = axes.get_legend_handles_labels()[1]
    assert len(labels) == len(answer.results) + 5  # the bound, no estimate at all, the star, budget and limit
    for word in ("recommended", "limit", "budget", "bound"):
        assert any(word in label for label in labels)
