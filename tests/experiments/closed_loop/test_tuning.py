import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.experiment_cases import HERE, StopsAfter, small
from tests.experiments.loop_answer_cases import configuration, made_up

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.answer import LoopAnswer
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, method_kind
from faintspot.experiments.closed_loop.question import LoopQuestion
from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.closed_loop.tuning import LoopPlan, tune_loop
from faintspot.experiments.running import WorkerPool

pytest.importorskip("hcipy")
SEARCH = Search(
    coarse_frames=25, frames=25, settle_frames=10, realisations=1, finalists=1, climbs=1, rounds=0
)
PLAN = LoopPlan(fluxes=3, frames=30, settle_frames=10, realisations=2, search=SEARCH)


def tuned(folder: Path, *methods: str, pool: WorkerPool = HERE) -> LoopAnswer:
    loop = small().replace("control", telemetry_frames=700)
    question = LoopQuestion(loop, magnitudes=(9.0, 11.0), methods=methods)
    return tune_loop(question, folder, plan=PLAN, pool=pool)


@pytest.mark.slow
def test_answer(tmp_path: Path) -> None:
    answer = tuned(tmp_path, "window+kalman")
    assert list(answer.kinds) == ["brightest", "window", "window+kalman"]
    assert (answer.photons.shape, answer.realisations, answer.scored_frames) == ((3,), 2, 20)
    assert answer.measured.strehl.shape == answer.measured.centroid_gain.shape == (3, 3, 2)
    assert (answer.measured.strehl > 0).all()
    assert (answer.runs("window")[-1] > answer.runs("window")[0]).all()  # six times the flux
    widths = [answer.choice("window", flux)["window_fwhm_px"] for flux in range(3)]
    assert widths == sorted(widths) or widths == sorted(widths, reverse=True)
    # What learns has the estimator's options that were tuned with the integrator.
    for flux in range(3):
        plain, learning = answer.choice("window", flux), answer.choice("window+kalman", flux)
        assert all(learning[name] == plain[name] for name in plain if name != LOOP_GAIN)


@pytest.mark.slow
def test_another_loop_in_the_folder_is_refused_or_replaced(tmp_path: Path) -> None:
    soon = WorkerPool(0, progress=StopsAfter(1))
    with pytest.raises(KeyboardInterrupt):
        tuned(tmp_path, pool=soon)
    other = LoopQuestion(small().replace("camera", read_noise_e=5.0), magnitudes=(9.0, 11.0), methods=())
    with pytest.raises(InputError, match=r"magnitude-tuning\.zarr"):
        tune_loop(other, tmp_path, plan=PLAN, pool=HERE)
    with pytest.raises(KeyboardInterrupt):
        tune_loop(other, tmp_path, plan=PLAN, pool=soon, overwrite=True)
    with pytest.raises(InputError, match=r"magnitude-tuning\.zarr"):
        tuned(tmp_path)


@pytest.mark.parametrize(
    ("name", "option", "place", "at_end"),
    [
        ("window", LOOP_GAIN, 3, False),
        ("window", LOOP_GAIN, -1, True),
        ("window", "window_fwhm_px", 0, True),
        ("map_predicted", "model_error", 0, False),  # it cannot be beyond
    ],
)
def test_values_at_the_end_of_what_was_on_offer(name: str, option: str, place: int, at_end: bool) -> None:
    answer = made_up({"brightest": -2.0, name: 0.0})
    tuned_values = {
        each: tunable.values for each, tunable in method_kind(name).tuned(configuration()).items()
    }
    choice = {each: values[len(values) // 2] for each, values in tuned_values.items()}
    text = json.dumps({**choice, option: tuned_values[option][place]})
    measured = replace(answer.measured, choices=np.full(answer.measured.choices.shape, text))
    assert (option in replace(answer, measured=measured).at_end(name, 0)) is at_end


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a LoopQuestion, got str"):
        tune_loop("canary", tmp_path)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"plan\.fluxes = 2"):
        LoopPlan(fluxes=2)
    with pytest.raises(InputError, match=r"plan\.frames = 60"):
        LoopPlan(frames=60)
