"""An engine in any state does what a plain model does, without waiting for clocks."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.patience import try_states

pytest.importorskip("pyshmem")

from tests.engine.engine_states import Engines

from faintspot.engine import request_handlers
from faintspot.engine.settings import estimators as estimators_module
from faintspot.engine.settings.estimators import EstimatorTrial
from faintspot.slopes.estimators import estimators
from faintspot.slopes.estimators.registry import restore


def tried_alone(trial: EstimatorTrial) -> dict[str, Any]:
    """Try a file as if in another process, which takes a second to begin."""
    before = estimators()
    try:
        return trial.here()
    finally:
        restore(before)


@pytest.fixture(autouse=True)
def without_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither for the frame of a change, which is yet to come, nor for another process."""
    monkeypatch.setattr(request_handlers, "EFFECT_TIMEOUT_S", 0.0)
    monkeypatch.setattr(estimators_module, "EFFECT_TIMEOUT_S", 0.0)
    monkeypatch.setattr(EstimatorTrial, "elsewhere", tried_alone)


@pytest.mark.hypothesis
def test_engines_do_what_a_plain_model_does() -> None:
    try_states(Engines, 3, 25)


@pytest.fixture
def engines() -> Iterator[Engines]:
    """With an estimator of a file in use."""
    machine = Engines()
    machine.begin(with_loop=False, with_file=True, dtype=np.uint16)
    yield machine
    machine.teardown()


@pytest.mark.parametrize("step", [1, 2])
def test_an_estimator_that_goes_on_failing_is_given_up(engines: Engines, step: int) -> None:
    """Also where numbers are left out, so that frames are in other slots than expected."""
    engines.frames(4 * ["bright"], step)
    engines.it_is_as_the_model()
    assert engines.model.running.settings.estimator == "brightest"


def test_an_estimator_that_is_unloaded_takes_no_turns(engines: Engines) -> None:
    """Also where it was the only one; settings can change then."""
    engines.interleave(["mine"], 1)
    engines.unload()
    engines.set_values("keep_brightest", 7, None)
    engines.frames(["spots 0"], 1)
    engines.it_is_as_the_model()


def test_a_frame_that_ends_early_is_lost_alone(engines: Engines) -> None:
    engines.frames_at_once(["spots 0", "spots 1", "spots 2"], 1, 2)
    engines.it_is_as_the_model()
    assert (engines.model.counters.processed, engines.model.counters.short) == (2, 1)
