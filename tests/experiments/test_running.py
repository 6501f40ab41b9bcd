"""Units give the same results whoever does them, however often they are interrupted."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.patience import wait_for
from tests.refusals import refused

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.experiments import running
from faintspot.experiments.running import Unit, WorkerPool, run_units
from faintspot.experiments.store import ZarrStore

with_processes = pytest.mark.slow

ROOT = Path(__file__).parents[2]
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


def note_and_sleep(folder: str, number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(1000)
    return {}


def sleep(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    if number:
        time.sleep(1000)
    return {"process": np.asarray(os.getpid())}


def gone(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False


def environment() -> dict[str, str]:
    """Environment of programs that import this package and its tests."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}


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
    store: dict[str, Any] = {}

    def stop(done: int, total: int) -> None:
        if done == 25:  # within the third unit
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_units(double, UNITS, store, WorkerPool(workers=0, progress=stop))
    assert [unit.key in store for unit in UNITS] == [True, True, False, False]
    assert values(run_units(double, UNITS, store, WorkerPool(workers=0))) == [0, 2, 4, 6]


@with_processes
def test_processes_give_the_same() -> None:
    said: list[str] = []
    counts: list[tuple[int, int]] = []
    place = WorkerPool(2, lambda *count: counts.append(count), said.append)
    assert values(run_units(double, UNITS, {}, place)) == [0, 2, 4, 6]
    assert counts[-1] == (40, 40)
    assert said == ["2 processes on this machine"]
    with refused("pip install"):
        run_units(without_package, UNITS, {}, WorkerPool(2))


@with_processes
def test_a_process_dies(tmp_path: Path) -> None:
    units = [Unit(unit.key, (str(tmp_path), *unit.arguments)) for unit in UNITS]
    assert values(run_units(die_once, units, {}, WorkerPool(2))) == [0, 2, 4, 6]


# A thread of loky may look for a unit that the interruption has taken away.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@with_processes
def test_interruption_does_not_wait_for_units() -> None:
    store: dict[str, Any] = {}
    units = [Unit("short", (0,), 2), Unit("long", (1,), 1), Unit("longer", (2,), 1)]

    def stop(done: int, total: int) -> None:
        if "short" in store and threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_units(sleep, units, store, WorkerPool(2, progress=stop))
    assert gone(int(store["short"]["process"]))


CHILD = """
from faintspot.experiments import running
from faintspot.experiments.running import Unit, WorkerPool, run_units
from tests.experiments.test_running import note_and_sleep
units = [Unit(str(number), ({folder!r}, number)) for number in range(4)]
run_units(note_and_sleep, units, dict(), WorkerPool(2))
"""


@with_processes
def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    program = subprocess.Popen([sys.executable, "-c", CHILD.format(folder=str(tmp_path))], env=environment())
    try:
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    finally:
        program.kill()
        program.wait()
    for note in tmp_path.iterdir():
        wait_for(lambda note=note: gone(int(note.name)))


OWN = """
from dataclasses import dataclass
from faintspot.experiments import StudySpecification, Sweep, WorkerPool, run
from faintspot.slopes.estimators import Estimator, register

@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Middle(Estimator):
    name = "middle"
    label = "the middle of the window"
    def locate(self, images, sensor, prior):
        return sensor.zero

sweep = Sweep("flux", flux_e=[30, 100, 300], pixels=8)
study = StudySpecification("own", [sweep], realisations=20, estimators=["middle"], fixed_k=[])
print(float(run(study, pool=WorkerPool(2))["error"].mean()))
"""


@with_processes
def test_own_estimators_reach_the_workers(tmp_path: Path) -> None:
    for package in ("xarray", "zarr"):
        pytest.importorskip(package)
    script = tmp_path / "own.py"
    script.write_text(OWN)
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment())
    assert ended.returncode == 0, ended.stderr
    assert 0.3 < float(ended.stdout) < 0.7  # as positions are within a pixel of the middle


@pytest.mark.parametrize("losses", [2, 3])
def test_units_of_lost_workers_are_run_again(monkeypatch: pytest.MonkeyPatch, losses: int) -> None:
    """Each time one unit is finished before the workers are lost; three losses end the run."""
    begun: list[list[int]] = []

    def by_joblib(function: Any, units: dict[int, Unit], *_: object) -> Iterator[tuple[int, Any]]:
        begun.append(list(units))
        for number, unit in list(units.items()):
            yield number, function(*unit.arguments, lambda done: None)
            if len(begun) <= losses:
                raise BrokenProcessPool("killed")

    monkeypatch.setattr(running, "_by_joblib", by_joblib)
    store: dict[str, Any] = {}
    if losses == 2:
        assert values(run_units(double, UNITS, store, WorkerPool(2))) == [0, 2, 4, 6]
    else:
        with refused("lost repeatedly", "kept"):
            run_units(double, UNITS, store, WorkerPool(2))
        assert sorted(store) == [unit.key for unit in UNITS[:3]]
    assert begun == [[0, 1, 2, 3], [1, 2, 3], [2, 3]]


def test_number_of_workers_is_checked() -> None:
    with refused("workers"):
        WorkerPool(workers=-1)


def test_a_scheduler_needs_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"faintspot\[cluster\]"):
        WorkerPool(scheduler="tcp://127.0.0.1:8786")
