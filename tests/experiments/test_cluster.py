"""Units on a Dask cluster, a scheduler and two workers as processes of this machine, whatever is killed."""

from __future__ import annotations

import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.experiments.test_running import UNITS, double, environment, impossible, values
from tests.refusals import refused

from faintspot.experiments import StudySpecification, Sweep, running
from faintspot.experiments.running import Unit, WorkerPool, run_units

distributed = pytest.importorskip("distributed", reason="needs distributed, of the extra `cluster`")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]


class Cluster:
    """A scheduler, for which a unit whose worker dies has failed, and two workers that nobody restarts."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self._port}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, workers: int = 2) -> None:
        """Start what is not running; workers end with their scheduler, though not at once."""
        if self.processes and self.processes["scheduler"].poll() is not None:
            self.stop()
        at = ["--host", "127.0.0.1", "--port", str(self._port)]
        worker = [self.address, "--no-nanny", "--nthreads", "1"]
        for name, arguments in (("scheduler", at), ("worker 1", worker), ("worker 2", worker))[: 1 + workers]:
            if name not in self.processes or self.processes[name].poll() is not None:
                program = [sys.executable, "-m", f"distributed.cli.dask_{name.split()[0]}", "--no-dashboard"]
                settings = environment() | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
                self.processes[name] = subprocess.Popen(
                    [*program, *arguments], env=settings, stderr=subprocess.DEVNULL
                )
        with distributed.Client(self.address, set_as_default=False, timeout=120) as client:
            client.wait_for_workers(workers, timeout=120)

    def stop(self) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()

    def pool(self, progress: Callable[[int, int], None] | None = None) -> WorkerPool:
        return WorkerPool(progress=progress, scheduler=self.address)


@pytest.fixture(scope="module")
def shared_cluster() -> Iterator[Cluster]:
    cluster = Cluster()
    try:
        yield cluster
    finally:
        cluster.stop()


@pytest.fixture
def cluster(shared_cluster: Cluster) -> Cluster:
    """A scheduler and two workers, also after a test that killed one."""
    shared_cluster.start()
    return shared_cluster


@pytest.fixture(autouse=True)
def collected() -> Iterator[None]:
    """Dask leaves sockets of lost connections to the garbage collector."""
    yield
    gc.collect()


def slowly(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    time.sleep(0.2)
    return {"twice": np.asarray(2 * number), "began": np.asarray(time.time())}


def test_a_cluster_gives_the_same(cluster: Cluster) -> None:
    said: list[str] = []
    counts: list[tuple[int, int]] = []
    pool = WorkerPool(None, lambda *count: counts.append(count), said.append, cluster.address)
    assert values(run_units(double, UNITS, {}, pool)) == [0, 2, 4, 6]
    assert counts[-1] == (40, 40)
    assert cluster.address in said[0]
    with refused("refused"):
        run_units(impossible, UNITS, {}, cluster.pool())


def where(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    advance(number)
    return {"process": np.asarray(os.getpid())}


def test_one_worker_of_one_thread_runs_all_units() -> None:
    """Never this process, although joblib runs units itself where it sees one processor."""
    one = Cluster()
    try:
        one.start(workers=1)
        store = run_units(where, UNITS, {}, one.pool())
        assert {int(store[unit.key]["process"]) for unit in UNITS} == {one.processes["worker 1"].pid}
    finally:
        one.stop()


def test_a_worker_of_another_version_is_refused(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "_VERSION", "faintspot 0.0.1 on Python 3.9.1")
    with refused("a worker has faintspot", "expected faintspot 0.0.1 on Python 3.9.1"):
        run_units(double, UNITS, {}, cluster.pool())


def test_studies_are_the_same_bit_for_bit_wherever_they_run(cluster: Cluster) -> None:
    experiments = pytest.importorskip("faintspot.experiments.study.run")
    sweep = Sweep("flux", flux_e=[30, 100, 300, 1000], pixels=8)
    study = StudySpecification("small", [sweep], realisations=200, estimators=["smoothed", "ml"], fixed_k=[])
    alone = experiments.run(study, pool=WorkerPool(1))
    for pool in (WorkerPool(3), cluster.pool()):
        assert experiments.run(study, pool=pool).identical(alone), pool


def test_a_killed_worker_loses_no_finished_unit(cluster: Cluster) -> None:
    store, killed = CountingStore(), threading.Event()

    def progress(finished: int, total: int) -> None:
        if finished >= 20 and not killed.is_set():
            killed.set()
            cluster.processes["worker 1"].kill()

    units = [Unit(f"unit {number}", (number,), 10) for number in range(8)]
    results = run_units(slowly, units, store, cluster.pool(progress))
    assert cluster.processes["worker 1"].wait() == -signal.SIGKILL
    assert [int(results[unit.key]["twice"]) for unit in units] == list(range(0, 16, 2))
    assert max(store.written.values()) == 1


class CountingStore(dict[str, Any]):
    def __init__(self) -> None:
        super().__init__()
        self.written: dict[str, int] = {}

    def __setitem__(self, key: str, result: Any) -> None:
        super().__setitem__(key, result)
        self.written[key] = self.written.get(key, 0) + 1


def test_a_scheduler_that_dies_is_one_line_and_loses_no_finished_unit(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "_CONNECT_S", 1)
    store: dict[str, Any] = {}

    def kill(done: int, total: int) -> None:
        if done == 10:
            cluster.processes["scheduler"].kill()

    with refused(cluster.address, "cannot be reached"):
        run_units(slowly, UNITS, store, cluster.pool(kill))
    assert any(unit.key in store for unit in UNITS)
    again = run_units(slowly, UNITS, store, WorkerPool(0))
    assert values(again) == [0, 2, 4, 6]


def test_schedulers_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "_CONNECT_S", 0.3)
    for address in ("tcp://127.0.0.1:1", "xyz://127.0.0.1:1"):
        with refused(f"scheduler = {address!r}", "cannot be reached"):
            run_units(double, UNITS, {}, WorkerPool(scheduler=address))
