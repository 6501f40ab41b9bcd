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
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.experiments.test_running import UNITS, die, double, environment, impossible, values
from tests.patience import wait_for
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
    time.sleep(0.5)
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
    for pool in (WorkerPool(2), WorkerPool(4), cluster.pool()):
        assert experiments.run(study, pool=pool).identical(alone), pool


def test_a_killed_worker_loses_no_finished_unit(cluster: Cluster) -> None:
    began = run_with(cluster.pool, cluster.processes["worker 1"].kill)
    assert cluster.processes["worker 1"].wait() == -signal.SIGKILL
    assert began == 1


def test_a_lost_connection_loses_no_finished_unit(cluster: Cluster) -> None:
    with Relay(cluster.address) as relay:
        assert run_with(lambda progress: WorkerPool(None, progress, None, relay.address), relay.cut) == 1
        assert relay.connections > 2


def run_with(pool: Callable[[Callable[[int, int], None]], WorkerPool], harm: Callable[[], object]) -> int:
    """Run units, do some harm after the second, and return how often the finished ones were written."""
    store, done = CountingStore(), threading.Event()

    def progress(finished: int, total: int) -> None:
        if finished >= 20 and not done.is_set():
            done.set()
            harm()

    units = [Unit(unit.key, unit.arguments, 10) for unit in UNITS] + [
        Unit(f"unit {number}", (number,), 10) for number in range(4, 8)
    ]
    results = run_units(slowly, units, store, pool(progress))
    assert done.is_set()
    assert [int(results[unit.key]["twice"]) for unit in units] == list(range(0, 16, 2))
    return max(store.written.values())


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


def test_units_that_kill_their_workers_are_given_up(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "_ATTEMPTS", 1)  # two workers would not do for three
    with refused("lost repeatedly", "kept"):
        run_units(die, UNITS, {}, cluster.pool())


CLIENT = """
import sys
from faintspot.experiments.running import Unit, WorkerPool, run_units
from faintspot.experiments.store import ZarrStore
from tests.experiments.test_cluster import slowly
units = [Unit(str(number), (number,)) for number in range(12)]
store = ZarrStore(sys.argv[1], "test", "fingerprint", [unit.key for unit in units])
before = sum(unit.key in store for unit in units)
run_units(slowly, units, store, WorkerPool(scheduler=sys.argv[2]))
print(before, [int(store[unit.key]["twice"]) for unit in units])
"""


def test_a_killed_client_loses_no_finished_unit(cluster: Cluster, tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    command = [sys.executable, "-c", CLIENT, str(tmp_path / "units.zarr"), cluster.address]
    first = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE)
    stored = tmp_path / "units.zarr" / "done" / "c"
    wait_for(lambda: stored.exists() and len(list(stored.iterdir())) > 2)
    first.kill()
    first.communicate()
    kept = len([chunk for chunk in stored.iterdir() if chunk.name.isdigit()])
    assert kept < 12
    again = subprocess.run(command, env=environment(), capture_output=True, text=True)
    assert again.returncode == 0, again.stderr
    assert again.stdout.strip() == f"{kept} {list(range(0, 24, 2))}"


def test_schedulers_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "_CONNECT_S", 0.3)
    for address in ("nowhere", "tcp://127.0.0.1:1", "xyz://127.0.0.1:1", "tls://127.0.0.1:1"):
        with refused(f"scheduler = {address!r}", "cannot be reached"):
            run_units(double, UNITS, {}, WorkerPool(scheduler=address))


class Relay:
    """A connection to the scheduler that can be cut."""

    def __init__(self, target: str) -> None:
        host, port = target.removeprefix("tcp://").split(":")
        self._target = host, int(port)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._ends: list[socket.socket] = []
        self.connections = 0

    def __enter__(self) -> Relay:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.close()
        self.cut()

    def cut(self) -> None:
        """End all connections; new ones are accepted."""
        while self._ends:
            with suppress(OSError):  # closed already
                self._ends.pop().shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            server = socket.create_connection(self._target)
            self.connections += 1
            self._ends.append(client)
            for pair in ((client, server), (server, client)):
                threading.Thread(target=self._pass_on, args=pair, daemon=True).start()

    @staticmethod
    def _pass_on(source: socket.socket, target: socket.socket) -> None:
        with source, target, suppress(OSError):
            while data := source.recv(1 << 16):
                target.sendall(data)
