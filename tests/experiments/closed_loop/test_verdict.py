from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from tests.experiments.result_cases import LABELS, made_up_budget, made_up_magnitude
from tests.refusals import refused

from faintspot.experiments.closed_loop.verdict import (
    NOWHERE,
    LoopResults,
    better_and_worse,
    loop_verdict,
    options_that_may_pay,
    reference_methods,
    tv_method,
)
from faintspot.loop.simulation.files import BUDGET_FILE, MAGNITUDE_FILE

pytest.importorskip("hcipy")


def test_no_gain_anywhere_is_said_exactly() -> None:
    lines = loop_verdict(LoopResults(made_up_magnitude(-0.3)))
    assert lines[0].startswith(NOWHERE)
    assert "lowers it beyond its error" in lines[0]


def test_a_gain_is_said() -> None:
    lines = loop_verdict(LoopResults(made_up_magnitude(0.3)))
    assert NOWHERE not in " ".join(lines)
    assert "beyond its error in" in lines[0]


def test_methods_are_found_by_their_names() -> None:
    result = dataclasses.replace(made_up_magnitude(), labels=tuple("abcd"))
    assert LABELS[reference_methods(result)[0]] == "brightest pixels"
    method = tv_method(result)
    assert method is not None
    assert LABELS[method] == "TV denoising"
    assert options_that_may_pay(result) == [("weighted reconstructor", 3, 2)]
    above, below = better_and_worse(result, 2, 0)
    assert above
    assert not below


def test_results_are_read_from_a_folder(tmp_path: Path) -> None:
    with refused("no results of a loop"):
        LoopResults.load(tmp_path)
    made_up_magnitude().save(tmp_path / MAGNITUDE_FILE)
    made_up_budget().save(tmp_path / BUDGET_FILE)
    found = LoopResults.load(tmp_path)
    assert found.magnitude is not None
    assert found.budget is not None


def test_gains_are_said_against_the_strongest_baseline_first() -> None:
    result = dataclasses.replace(made_up_magnitude(), names=("brightest", "tv", "window", "ml"))
    assert reference_methods(result) == [2, 0]
    lines = [line for line in loop_verdict(LoopResults(magnitude=result)) if line.startswith("Magnitudes")]
    against = [line.split(" against ")[1].split(":")[0] for line in lines]
    window, brightest = result.labels[2], result.labels[0]
    assert against == [window, window, window, brightest, brightest]
