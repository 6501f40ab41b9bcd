"""Whatever changes in a running engine a thousand times leaves nothing behind: memory, threads, descriptors.

The garbage collector is off, as it is while frames come. FAINTSPOT_LEAK_TIMES=50 makes fifty times as many
changes: 10,000 of settings, 1000 of estimators and of cameras take a few minutes.
"""

import gc
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.engine.bench import Bench, simulated
from tests.engine.estimator_files import write
from tests.patience import wait_for

from faintspot.base.files import Closing
from faintspot.engine.settings.estimators import EstimatorTrial

pytestmark = pytest.mark.slow

TIMES = int(os.environ.get("FAINTSPOT_LEAK_TIMES", "1"))
FEW = 10 * TIMES
ROUNDS = 4  # in the first, code is compiled and the heap takes its size


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


class Changing(Closing):
    """An engine, a camera that sends a frame after every change, and what the changes left behind."""

    def __init__(self) -> None:
        self.bench = Bench(deadline_s=0.5)
        self.ring = self.bench.ring()
        self.bench.attached()
        self._data: NDArray[np.uint16] = simulated(4)
        self._sent = 0
        for _ in range(500):  # until dark sub-apertures have been looked for
            self.send()

    def send(self) -> None:
        self.bench.send(self.ring, self._sent, self._data[self._sent % 4])
        self._sent += 1

    def restart_camera(self) -> None:
        self.ring.close()
        self.bench.detached()
        self.ring = self.bench.ring()
        self.bench.attached()

    def left_behind(self, change: Callable[[int], None], count: int) -> dict[str, int]:
        """Make changes in rounds, and return how much more is held after the round that left least.

        A leak grows in every round, the heap of a thread or a table that doubles in one.
        """
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            grown = []
            for first in range(0, ROUNDS * count, count):
                before = held()
                for number in range(first, first + count):
                    change(number)
                    self.send()
                wait_for(lambda before=before: held()["threads"] <= before["threads"] + 1)
                grown.append({name: value - before[name] for name, value in held().items()})
            return {name: min(each[name] for each in grown) for name in grown[0]}
        finally:
            gc.enable()
            gc.unfreeze()

    def close(self) -> None:
        self.bench.close()


def assert_nothing(left: dict[str, int], count: int, bytes_each: int) -> None:
    """A quarter of a megabyte is the heap's own; the module that runs last may be between two threads."""
    assert left["bytes"] < 2**18 + bytes_each * count, left
    assert left["threads"] <= 1, left
    assert left["descriptors"] <= 2, left
    assert left["imported"] <= 3, left


def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of frames alone, changes of settings, versions of an estimator's file, and cameras.

    A thousand entries of the history, 1 kB each, are bounded. The trial in another process is left out.
    """
    pytest.importorskip("pyshmem")
    monkeypatch.setattr("faintspot.engine.settings.estimators.EFFECT_TIMEOUT_S", 0.0)  # the frame comes later
    monkeypatch.setattr(EstimatorTrial, "elsewhere", EstimatorTrial.here)
    with Changing() as changing:
        engine = changing.bench.engine
        estimators, live = engine.estimators, engine.live

        def change_settings(number: int) -> None:
            where = None if number % 2 else [0, 3, 7]
            live.propose({"noise_std": 0.5 + number % 50 / 50}, where)

        def swap(number: int) -> None:
            estimators.load(str(write(tmp_path, f"return sensor.zero + {number % 7} / 10")), replace=True)

        assert_nothing(changing.left_behind(lambda number: None, 300), 0, 0)
        count = 60 * TIMES
        assert_nothing(changing.left_behind(change_settings, count), min(count, 1000), 2000)
        assert live.change_number >= ROUNDS * count
        estimators.load(str(write(tmp_path, "return sensor.zero")))
        live.propose({"estimator": "mine"})
        assert_nothing(changing.left_behind(swap, FEW), FEW, 1000)
        assert estimators.fault is None
        estimators.unload("mine")
        assert_nothing(changing.left_behind(lambda number: changing.restart_camera(), FEW), FEW, 1000)
        assert engine.counters.source_restarts >= ROUNDS * FEW
