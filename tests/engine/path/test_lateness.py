"""Causes of late frames."""

import mmap

from faintspot.engine.path.timing import IN_TIME, OTHER, PAGE_FAULT, PREPARING, WOKEN_LATE, Lateness


def test_a_frame_in_time_has_no_cause() -> None:
    assert Lateness().cause(False, True, 1, 0) == IN_TIME


def test_settings_that_are_prepared_come_first() -> None:
    assert Lateness().cause(True, True, 1, 0) == PREPARING


def test_a_page_that_was_missing() -> None:
    lateness = Lateness()
    lateness.cause(False, False, 0, 0)
    with mmap.mmap(-1, 1 << 20) as memory:
        memory[1 << 19] = 1
        assert lateness.cause(True, False, 0, 0) == PAGE_FAULT


def test_only_what_has_happened_since_the_frame_before_counts() -> None:
    lateness = Lateness()
    causes = set()
    for _ in range(20):  # now and then something really happens
        lateness.cause(False, False, 3, 0)
        causes.add(lateness.cause(True, False, 3, 0))
    assert OTHER in causes
    assert WOKEN_LATE not in causes
    assert any(lateness.cause(True, False, 4 + k, 0) == WOKEN_LATE for k in range(20))
