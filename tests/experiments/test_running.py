"""Units give the same results whoever does them, however often they are interrupted."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

from faintspot.base.errors import InputError, MissingExtraError
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
    place = WorkerPool(2, lambda *count: counts.append(count), said.append)
    assert values(run_units(double, UNITS, MemoryStore(), place)) == [0, 2, 4, 6]
    assert counts[-1] == (40, 40)
    assert said == ["2 processes on this machine"]
    for function, message in ((impossible, "refused"), (without_package, "pip install")):
        with pytest.raises(InputError, match=message):
            run_units(function, UNITS[:1], MemoryStore(), WorkerPool(1))


def test_a_process_dies(tmp_path: Path) -> None:
    units = [Unit(unit.key, (str(tmp_path), *unit.arguments)) for unit in UNITS]
    assert values(run_units(die_once, units, MemoryStore(), WorkerPool(1))) == [0, 2, 4, 6]
    with refused("died repeatedly"):
        run_units(die, UNITS[:1], MemoryStore(), WorkerPool(1))


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
