"""Long-lived threads: every share once, sleep, death."""

import threading
import time
from contextlib import closing

import numpy as np
import pytest
from tests.patience import LIMIT_S, wait_for

from faintspot.engine.frames.workers import SlopePrior, Workers


@pytest.mark.slow
def test_every_share_is_done_once_whatever_became_of_the_last() -> None:
    """After one that did not come to its end, sleep, and the death of a thread, whose share is given up."""
    done: list[tuple[int, int]] = []
    outcome: list[bool] = []

    def deadly(share: int) -> bool:
        if share == 1:
            raise MemoryError("no more")
        return True

    with closing(Workers(2, cpus=[0])) as workers:

        def all_do(job: int) -> None:
            def do(share: int) -> bool:
                done.append((job, share))
                return True

            workers.post(do)
            assert workers.wait()

        for job in range(100):
            all_do(job)
        workers.post(lambda share: share != 2)
        assert not workers.wait()
        all_do(100)
        workers.park()
        time.sleep(0.01)
        workers.wake()
        all_do(101)
        workers.post(deadly)
        waiting = threading.Thread(target=lambda: outcome.append(workers.wait()))
        waiting.start()
        wait_for(workers.replace_dead)
        waiting.join(LIMIT_S)
        assert outcome == [False]
        all_do(102)
    assert sorted(done) == [(job, share) for job in range(103) for share in (1, 2)]


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
