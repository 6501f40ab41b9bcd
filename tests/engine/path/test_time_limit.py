"""Calls that may never come back."""

import threading

import pytest
from tests.patience import wait_for

import faintspot as fs
from faintspot.engine.path.python_path import call_is_under_way, call_within, end_thread

pytestmark = pytest.mark.slow

PATIENCE_S = 10.0


def forever() -> None:
    while True:
        pass


def test_what_comes_back_in_time() -> None:
    assert call_within(PATIENCE_S, "sum", lambda *numbers: sum(numbers), 1, 2) == 3
    assert call_within(PATIENCE_S, "nothing", lambda: None) is None
    assert call_within(PATIENCE_S, "itself", call_is_under_way)


def test_its_errors_are_the_callers() -> None:
    with pytest.raises(ValueError, match="two"):
        call_within(PATIENCE_S, "number", int, "two")


def test_what_does_not_come_back() -> None:
    known = set(threading.enumerate())
    with pytest.raises(fs.InputError, match=r"^loop: did not return within 0\.05 s$"):
        call_within(0.05, "loop", forever)
    wait_for(lambda: not set(threading.enumerate()) - known)
    assert not call_is_under_way()


def test_a_thread_that_has_not_begun_is_left_alone() -> None:
    end_thread(threading.Thread(target=forever))
