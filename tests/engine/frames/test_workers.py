"""Long-lived threads: every share once, sleep, death."""

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from tests.patience import LIMIT_S, wait_for

from faintspot.engine.frames.workers import SlopePrior, Workers


@pytest.fixture
def workers() -> Iterator[Workers]:
    made = Workers(2)
    yield made
    made.close()


@pytest.mark.slow
def test_every_share_is_done_once(workers: Workers) -> None:
    done: list[tuple[int, int]] = []
    for job in range(100):

        def task(share: int, job: int = job) -> bool:
            done.append((job, share))
            return True

        workers.post(task)
        assert workers.wait()
    assert sorted(done) == [(job, share) for job in range(100) for share in (1, 2)]


@pytest.mark.slow
def test_a_share_that_did_not_come_to_its_end(workers: Workers) -> None:
    workers.post(lambda share: share != 2)
    assert not workers.wait()
    workers.post(lambda share: True)
    assert workers.wait()


@pytest.mark.slow
def test_they_sleep_and_wake(workers: Workers) -> None:
    workers.park()
    time.sleep(0.01)
    workers.wake()
    workers.post(lambda share: True)
    assert workers.wait()


@pytest.mark.slow
def test_a_dead_one_is_replaced(workers: Workers) -> None:
    """Its share is given up, and the next task is whole again."""

    def deadly(share: int) -> bool:
        if share == 1:
            raise MemoryError("no more")
        return True

    outcome: list[bool] = []
    workers.post(deadly)
    waiting = threading.Thread(target=lambda: outcome.append(workers.wait()))
    waiting.start()
    wait_for(workers.replace_dead)
    waiting.join(LIMIT_S)
    assert outcome == [False]
    workers.post(lambda share: True)
    assert workers.wait()


@pytest.mark.slow
def test_pinned_where_there_is_such_a_processor() -> None:
    workers = Workers(1, cpus=[0])
    workers.post(lambda share: True)
    assert workers.wait()
    workers.close()


def test_what_is_expected_and_how_surely() -> None:
    """Widths are the rms of both axes; what no frame can hold is not expected, what says nothing is NaN."""
    prior = SlopePrior(3, 10.0)
    mean = np.array([1.0, 11.0, np.nan, -2.0, 3.0, -10.0])
    std = np.array([3.0, 1.0, np.inf, 4.0, 0.0, 1.0])
    prior.expect(mean, std)
    np.testing.assert_array_equal(prior.mean_px, [[[1.0, 0.0, 0.0], [-2.0, 3.0, -10.0]]])
    np.testing.assert_allclose(prior.std_px, [np.sqrt(12.5), np.nan, np.nan])
    assert prior.changes == 1
    prior.expect(-mean, std)  # as sure as before
    assert prior.changes == 1
    prior.expect(mean, std.copy())
    assert prior.changes == 2
    prior.forget()
    assert not prior.mean_px.any()
    assert np.isnan(prior.std_px).all()
    assert prior.changes == 3
