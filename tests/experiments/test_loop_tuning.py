from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import HERE, StopsAfter, assert_same_units, small

from faintspot.base.errors import InputError
from faintspot.experiments.loop_answer import LoopAnswer
from faintspot.experiments.loop_arms import LOOP_GAIN, arm_kind
from faintspot.experiments.loop_question import LoopQuestion
from faintspot.experiments.loop_tuning import LoopPlan, tune_loop, values_at_end
from faintspot.experiments.running import WorkerPool
from faintspot.experiments.search import Search

pytest.importorskip("hcipy")
SEARCH = Search(
    coarse_frames=25, frames=25, settle_frames=10, realisations=1, finalists=1, climbs=1, rounds=0
)
PLAN = LoopPlan(fluxes=3, frames=30, settle_frames=10, realisations=2, search=SEARCH)


def question(**asked: Any) -> LoopQuestion:
    loop = small().replace("control", telemetry_frames=200)
    return LoopQuestion(loop, magnitudes=(9.0, 11.0), **{"arms": ("window+kalman",), **asked})


def tuned(folder: Path, place: WorkerPool = HERE, **asked: Any) -> LoopAnswer:
    return tune_loop(question(**asked), folder, plan=PLAN, place=place)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, LoopAnswer]:
    folder = tmp_path_factory.mktemp("tune")
    return folder, tuned(folder)


def test_answer(whole: tuple[Path, LoopAnswer]) -> None:
    _, answer = whole
    assert [result.name for result in answer.results] == ["brightest", "window", "window+kalman"]
    assert (answer.photons.shape, answer.realisations, answer.scored_frames) == ((3,), 2, 20)
    for result in answer.results:
        assert result.strehl.shape == result.centroid_gain.shape == (3, 2)
        assert (result.strehl > 0).all()
    assert (answer["window"].strehl[-1] > answer["window"].strehl[0]).all()  # six times the flux
    # What learns has the estimator's options that were tuned with the integrator.
    for plain, learning in zip(answer["window"].choices, answer["window+kalman"].choices, strict=True):
        assert all(learning[name] == plain[name] for name in plain if name != LOOP_GAIN)
        assert "noise_scale" in learning


def test_interrupted_it_goes_on_to_the_same_answer(tmp_path: Path, whole: tuple[Path, LoopAnswer]) -> None:
    folder, answer = whole
    with pytest.raises(KeyboardInterrupt):
        tuned(tmp_path, WorkerPool(0, progress=StopsAfter(60)))
    again = tuned(tmp_path)
    assert_same_units(tmp_path, folder)
    np.testing.assert_array_equal(again["window+kalman"].strehl, answer["window+kalman"].strehl)


def test_candidates_that_there_is_no_time_for_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LoopQuestion, "_default", lambda self: ["window+kalman"])
    answer = tuned(tmp_path, arms=None, minutes=1e-6)
    assert [result.name for result in answer.results] == ["brightest", "window"]
    assert "of the 1e-06 minutes" in answer.left_out["window+kalman"]
    answer = tuned(tmp_path, arms=None, minutes=5.0)
    assert answer.results[-1].name == "window+kalman"


def test_another_loop_in_the_folder_is_refused_or_replaced(tmp_path: Path) -> None:
    tuned(tmp_path, arms=())
    other = LoopQuestion(small().replace("camera", read_noise_e=5.0), magnitudes=(9.0, 11.0), arms=())
    with pytest.raises(InputError, match=r"magnitude-tuning\.zarr"):
        tune_loop(other, tmp_path, plan=PLAN, place=HERE)
    answer = tune_loop(other, tmp_path, plan=PLAN, place=HERE, overwrite=True)
    assert answer.question is other


def test_values_at_the_end_of_what_was_on_offer() -> None:
    kind, loop = arm_kind("window"), small()
    tuned_values = {name: each.values for name, each in kind.tuned(loop).items()}
    widths, gains = tuned_values["window_fwhm_px"], tuned_values[LOOP_GAIN]
    inside = {LOOP_GAIN: gains[3], "window_fwhm_px": widths[2]}
    assert values_at_end(kind, loop, inside) == ()
    assert values_at_end(kind, loop, {**inside, LOOP_GAIN: gains[-1]}) == (LOOP_GAIN,)
    assert values_at_end(kind, loop, {**inside, "window_fwhm_px": widths[0]}) == ("window_fwhm_px",)


def test_a_choice_that_cannot_be_beyond_is_not_at_an_end() -> None:
    kind, loop = arm_kind("map_predicted"), small()
    values = {name: each.values[0] for name, each in kind.tuned(loop).items()}
    assert "model_error" not in values_at_end(kind, loop, {**values, "model_error": 0.0})


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a LoopQuestion, got str"):
        tune_loop("canary", tmp_path)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"plan\.fluxes = 2"):
        LoopPlan(fluxes=2)
    with pytest.raises(InputError, match=r"plan\.frames = 60"):
        LoopPlan(frames=60)
