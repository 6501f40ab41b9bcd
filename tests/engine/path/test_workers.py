"""Long-lived threads: every share once, sleep, death."""

import threading
import time
from collections.abc import Iterator

import pytest
from tests.patience import LIMIT_S, wait_for

from faintspot.engine.path.workers import Workers

pytestmark = pytest.mark.slow


@pytest.fixture
def workers() -> Iterator[Workers]:
    made = Workers(2)
    yield made
    made.close()


def test_every_share_is_done_once(workers: Workers) -> None:
    done: list[tuple[int, int]] = []
    for job in range(100):

        def task(share: int, job: int = job) -> bool:
            done.append((job, share))
            return True

        workers.post(task)
        assert workers.wait()
    assert sorted(done) == [(job, share) for job in range(100) for share in (1, 2)]


def test_a_share_that_did_not_come_to_its_end(workers: Workers) -> None:
    workers.post(lambda share: share != 2)
    assert not workers.wait()
    workers.post(lambda share: True)
    assert workers.wait()


def test_they_sleep_and_wake(workers: Workers) -> None:
    workers.park()
    time.sleep(0.01)
    workers.wake()
    workers.post(lambda share: True)
    assert workers.wait()


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
    assert workers.fault == "MemoryError: no more"
    workers.post(lambda share: True)
    assert workers.wait()


def test_pinned_where_there_is_such_a_processor() -> None:
    workers = Workers(1, cpus=[0])
    workers.post(lambda share: True)
    assert workers.wait()
    workers.close()
