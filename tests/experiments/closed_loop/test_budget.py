import functools
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.experiment_cases import HERE, SEARCH, small

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.budget import TERMS, run_budget
from faintspot.experiments.closed_loop.experiment import scored_runs
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, with_choice
from faintspot.experiments.closed_loop.results import BudgetResult
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.record import BUDGET_FILE
from faintspot.loop.simulation.simulation import simulate_loop

pytest.importorskip("hcipy")
KIND = Method.named("brightest")
CHOICE = {LOOP_GAIN: 0.5, "keep_brightest": 16}

RUN = {"frames": 300, "settle_frames": 40, "realisations": 1}
FAINT = small().replace("camera", photons_per_subaperture=40.0).replace("run", **RUN)


@functools.cache
def strehl(term: str) -> float:
    return float(scored_runs(KIND, FAINT, CHOICE, TERMS[term], lambda frames: None)["strehl"][0])


def test_without_nothing_it_is_the_loop_itself() -> None:
    record = simulate_loop(FAINT, [with_choice(KIND, FAINT, CHOICE)])
    assert strehl("nothing") == pytest.approx(record.mean_strehl(), abs=1e-12)
    found = scored_runs(KIND, FAINT, CHOICE, TERMS["nothing"], lambda frames: None)["residual_nm"][0]
    assert found == pytest.approx(np.sqrt(np.mean(record.residual_nm[40:] ** 2)))


@pytest.mark.parametrize(
    "term", ["photon and read noise", "fitting and aliasing", "slope error", "slope error and servo lag"]
)
def test_without_an_error_the_strehl_ratio_is_higher(term: str) -> None:
    assert strehl(term) > strehl("nothing") + 0.01


def test_less_error_less_loss() -> None:
    assert strehl("slope error and servo lag") > strehl("slope error") > strehl("photon and read noise")


def test_gain_of_the_run_is_near_the_calibrated_one() -> None:
    """The calibration sees wavefronts as in the loop: what is left of the gain's error costs little."""
    assert strehl("centroid gain error") == pytest.approx(strehl("nothing"), abs=0.08)


@pytest.mark.slow
def test_every_term_is_measured(tmp_path: Path) -> None:
    result = run_budget(small(), tmp_path, ["brightest"], search=SEARCH, pool=HERE)
    assert result.terms == tuple(TERMS)
    assert result.strehl.shape == result.residual_nm.shape == (1, len(TERMS), 2)
    assert np.isfinite(result.strehl).all()
    assert (BudgetResult.load(tmp_path / BUDGET_FILE).strehl == result.strehl).all()


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="methods: expected at least one"):
        run_budget(small(), tmp_path, [], pool=HERE)
    with pytest.raises(InputError, match=r"control.mode = 'open'"):
        run_budget(small().replace("control", mode="open"), tmp_path, pool=HERE)
