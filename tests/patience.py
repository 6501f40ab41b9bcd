"""How long tests wait for other processes and threads, and how many examples they try."""

import time
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

LIMIT_S = 60.0
"""How long to wait for what must come."""

USUAL_EXAMPLES = 15
"""How many examples a property is tried with; a profile may have more."""


def examples(count: int) -> settings:
    """Try `count` examples instead of the usual number, and as many times more as the profile does."""
    return settings(max_examples=count * settings().max_examples // USUAL_EXAMPLES)


def try_states(machine: type[RuleBasedStateMachine], count: int, steps: int) -> None:
    """Run a state machine `count` times as for `examples`, with at most so many steps.

    The steps to a failure are not shortened, which would take minutes.
    """
    phases = (Phase.explicit, Phase.reuse, Phase.generate)
    run_state_machine_as_test(
        machine, settings=settings(examples(count), stateful_step_count=steps, phases=phases)
    )


def wait_for(condition: Any, what: object = "", step: Any = lambda: time.sleep(0.001)) -> None:
    """Wait until something is so, or take steps until it is; fail after `LIMIT_S`."""
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, what() if callable(what) else what
        step()


def mostly_slow(fast: int, cases: Iterable[Any]) -> list[Any]:
    """Return the cases of a parametrised test, with the marker `slow` on all but the first few."""
    return [
        case
        if number < fast
        else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for number, case in enumerate(cases)
    ]
