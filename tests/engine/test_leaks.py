"""Whatever changes in a running engine a thousand times leaves nothing behind: memory, threads, descriptors.

The garbage collector is off, as it is while frames come. FAINTSPOT_LEAK_TIMES=50 makes fifty times as many
changes: 10,000 of settings, 1000 of estimators and of cameras take a few minutes.
"""

import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.engine.bench import Bench, simulated
from tests.engine.estimator_files import write

from faintspot.engine.settings.estimators import EstimatorTrial

pytestmark = pytest.mark.slow

TIMES = int(os.environ.get("FAINTSPOT_LEAK_TIMES", "1"))
FEW = max(50, 20 * TIMES)
PATIENCE_S = 10.0  # for threads that are about to end
FIRST = 12  # changes before the count begins: everything is compiled, and the heap has its size


def held() -> dict[str, int]:
    """What the process holds."""
    with open("/proc/self/statm") as statm:
        resident = int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return {
        "bytes": resident,
        "threads": threading.active_count(),
        "descriptors": len(os.listdir("/proc/self/fd")),
        "imported": len(sys.modules),
    }


class Changing:
    """An engine, a camera that sends a frame after every change, and what the changes left behind."""

    def __init__(self) -> None:
        self.bench = Bench(deadline_s=0.5)
        self.ring = self.bench.ring()
        self.bench.attached()
        self._data: NDArray[np.uint16] = simulated(4)
        self._sent = 0

    def send(self) -> None:
        self.bench.send(self.ring, self._sent, self._data[self._sent % 4])
        self._sent += 1

    def restart_camera(self) -> None:
        self.ring.close()
        self.bench.detached()
        self.ring = self.bench.ring()
        self.bench.attached()

    def left_behind(self, change: Callable[[int], None], count: int) -> dict[str, int]:
        """Make changes, and return how much more is held than after the first ones."""
        for number in range(FIRST):
            change(number)
            self.send()
        gc.collect()
        gc.freeze()
        gc.disable()
        before = held()
        for number in range(FIRST, FIRST + count):
            change(number)
            self.send()
        end = time.monotonic() + PATIENCE_S
        while held()["threads"] > before["threads"] + 1 and time.monotonic() < end:
            time.sleep(0.01)
        return {name: value - before[name] for name, value in held().items()}

    def close(self) -> None:
        gc.enable()
        gc.unfreeze()
        self.bench.close()


@pytest.fixture
def changing() -> Iterator[Changing]:
    pytest.importorskip("pyshmem")
    changing = Changing()
    yield changing
    changing.close()


def assert_nothing(left: dict[str, int], count: int, bytes_each: int) -> None:
    """A megabyte is the heap's own; the module that runs last may be between two threads."""
    assert left["bytes"] < 2**20 + bytes_each * count, left
    assert left["threads"] <= 1, left
    assert left["descriptors"] <= 2, left
    assert left["imported"] <= 3, left


def test_frames_alone_leave_no_memory_behind(changing: Changing) -> None:
    """Two thousand frames take less than 1 MB."""
    assert_nothing(changing.left_behind(lambda number: None, 2000), 0, 0)


def test_changes_of_settings(changing: Changing) -> None:
    """A pipeline that stays takes 400 kB here; a thousand entries of the history, 1 kB each, are bounded."""

    def change(number: int) -> None:
        where = None if number % 2 else [0, 3, 7]
        changing.bench.engine.live.propose({"noise_std": 0.5 + number % 50 / 50}, where)

    count = 200 * TIMES
    left = changing.left_behind(change, count)
    assert changing.bench.engine.live.change_number >= count
    assert_nothing(left, min(count, 1000), 2000)


def test_swaps_of_an_estimator(changing: Changing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every one is another version of its file, in use; the trial in another process is left out."""
    # Its frame comes after the change.
    monkeypatch.setattr("faintspot.engine.settings.estimators.EFFECT_TIMEOUT_S", 0.0)
    monkeypatch.setattr(EstimatorTrial, "elsewhere", EstimatorTrial.here)
    estimators, live = changing.bench.engine.estimators, changing.bench.engine.live
    estimators.load(str(write(tmp_path, "return sensor.zero")))
    live.propose({"estimator": "mine"})

    def change(number: int) -> None:
        estimators.load(str(write(tmp_path, f"return sensor.zero + {number % 7} / 10")), replace=True)

    count = FEW
    assert_nothing(changing.left_behind(change, count), count, 1000)
    assert estimators.fault is None
    estimators.unload("mine")


def test_restarts_of_the_camera(changing: Changing) -> None:
    count = FEW
    left = changing.left_behind(lambda number: changing.restart_camera(), count)
    assert changing.bench.engine.counters.source_restarts >= count
    assert_nothing(left, count, 1000)
