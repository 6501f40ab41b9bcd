"""Units give the same results whoever does them, however often they are interrupted."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.experiments import running
from faintspot.experiments.running import Unit, WorkerPool, run_units
from faintspot.experiments.store import MemoryStore, ZarrStore

pytestmark = pytest.mark.machine_time("starts other processes")

UNITS = [Unit(f"unit {number}", (number,), 10) for number in range(4)]


def double(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    advance(5)
    advance(50)  # more than was expected
    return {"twice": np.asarray(2 * number)}


def never(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    raise AssertionError


def impossible(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    raise InputError(f"number = {number}: refused")


def without_package(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    raise MissingExtraError("hcipy", "loop", "This")


def sockets_of(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    """Kinds of the sockets that this process and its parent listen on."""
    listening = [
        f"{family} {line}"
        for family in ("tcp", "tcp6")
        for process in (os.getpid(), os.getppid())
        for line in Path(f"/proc/{process}/net/{family}").read_text().splitlines()[1:]
        if line.split()[3] == "0A" and line.split()[9] in _inodes(process)
    ]
    return {"listening": np.asarray(len(listening))}


def _inodes(process: int) -> set[str]:
    found = set()
    for entry in Path(f"/proc/{process}/fd").iterdir():
        try:
            target = os.readlink(entry)
        except OSError:
            continue
        if target.startswith("socket:"):
            found.add(target[8:-1])
    return found


def die_once(folder: str, number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    mark = Path(folder) / "died"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"twice": np.asarray(2 * number)}


def die(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def sleep(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    if number:
        time.sleep(1000)
    return {"process": np.asarray(os.getpid())}


def values(results: Any) -> list[int]:
    return [int(results[unit.key]["twice"]) for unit in UNITS]


def test_units_are_run_once(tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    counts: list[tuple[int, int]] = []
    place = WorkerPool(workers=0, progress=lambda *count: counts.append(count))
    keys = [unit.key for unit in UNITS]
    assert values(run_units(double, UNITS, ZarrStore(tmp_path / "a", "t", "f", keys), place)) == [0, 2, 4, 6]
    assert counts[:2] == [(0, 40), (5, 40)]
    assert counts[-1] == (40, 40)
    counts.clear()
    assert values(run_units(never, UNITS, ZarrStore(tmp_path / "a", "t", "f", keys), place)) == [0, 2, 4, 6]
    assert not counts


def test_interrupted_and_started_again() -> None:
    store = MemoryStore()

    def stop(done: int, total: int) -> None:
        if done == 25:  # within the third unit
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_units(double, UNITS, store, WorkerPool(workers=0, progress=stop))
    assert [store.done(unit.key) for unit in UNITS] == [True, True, False, False]
    assert values(run_units(double, UNITS, store, WorkerPool(workers=0))) == [0, 2, 4, 6]


def test_processes_give_the_same() -> None:
    said: list[str] = []
    counts: list[tuple[int, int]] = []
    place = WorkerPool(2, None, lambda *count: counts.append(count), said.append)
    assert values(run_units(double, UNITS, MemoryStore(), place)) == [0, 2, 4, 6]
    assert counts[-1] == (40, 40)
    assert said == ["2 processes on this machine"]
    for function, message in ((impossible, "refused"), (without_package, "pip install")):
        with pytest.raises(InputError, match=message):
            run_units(function, UNITS[:1], MemoryStore(), WorkerPool(1))


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads /proc")
def test_nobody_can_reach_the_processes() -> None:
    result = run_units(sockets_of, UNITS[:1], MemoryStore(), WorkerPool(1))
    assert int(result["unit 0"]["listening"]) == 0


def test_a_process_dies(tmp_path: Path) -> None:
    units = [Unit(unit.key, (str(tmp_path), *unit.arguments)) for unit in UNITS]
    assert values(run_units(die_once, units, MemoryStore(), WorkerPool(1))) == [0, 2, 4, 6]
    with pytest.raises(InputError, match="died repeatedly") as raised:
        run_units(die, UNITS[:1], MemoryStore(), WorkerPool(1))
    assert "\n" not in str(raised.value)


def test_interruption_does_not_wait_for_units() -> None:
    store = MemoryStore()
    units = [Unit("short", (0,), 2), Unit("long", (1,), 1)]

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_units(sleep, units, store, WorkerPool(1, progress=stop))
    assert store.done("short")
    process = int(store.read("short")["process"])
    assert not Path(f"/proc/{process}").exists() or not Path("/proc").exists()


def test_number_of_workers_is_checked() -> None:
    with pytest.raises(InputError, match="workers"):
        WorkerPool(workers=-1)


# A Dask cluster ----------------------------------------------------------------------------------------


@pytest.fixture
def scheduler() -> Iterator[str]:
    """Address of a Dask scheduler without workers."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=0, dashboard_address="localhost:0", silence_logs=logging.CRITICAL
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def two_workers(scheduler: str) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Two Dask workers, processes of their own that nobody restarts."""
    arguments = ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--death-timeout", "60"]
    command = [sys.executable, "-m", "distributed.cli.dask_worker", scheduler, *arguments]
    folders = [str(Path(faintspot.__file__).parents[1]), str(Path(__file__).parents[2])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    workers = [
        subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(2)
    ]
    yield workers
    for worker in workers:
        worker.kill()
        worker.wait()


def test_one_of_two_dask_workers_is_killed(
    scheduler: str, two_workers: list[subprocess.Popen[bytes]]
) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    counts = []
    said: list[str] = []

    def kill_one(done: int, total: int) -> None:
        counts.append(done)
        if done == 10:
            os.kill(two_workers[0].pid, signal.SIGKILL)

    place = WorkerPool(None, scheduler, kill_one, said.append)
    assert values(run_units(double, UNITS, MemoryStore(), place)) == [0, 2, 4, 6]
    assert two_workers[0].wait() == -signal.SIGKILL
    assert counts[-1] == 40
    assert scheduler in said[0]
    with pytest.raises(InputError, match="refused"):
        run_units(impossible, UNITS[:1], MemoryStore(), WorkerPool(scheduler=scheduler))


def test_workers_of_another_version_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="another version"):
        running._on_worker(double, "unit 0", (0,), "topic", "other")


def test_schedulers_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(running, "_CONNECT_TIMEOUT_S", 0.3)
    for address in ("nowhere", "tcp://127.0.0.1:1", "xyz://127.0.0.1:1"):
        with pytest.raises(InputError, match=r"scheduler = .*cannot be reached") as raised:
            run_units(double, UNITS, MemoryStore(), WorkerPool(scheduler=address))
        assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match="expected certificates"):
        run_units(double, UNITS, MemoryStore(), WorkerPool(scheduler="tls://127.0.0.1:1"))
