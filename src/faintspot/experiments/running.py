"""Running units of work over processes of this machine.

No port is opened: processes talk through pipes that nobody else can reach.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.experiments.store import Arrays, UnitStore
from faintspot.slopes.kernels.parallel import available_cpus

Progress = Callable[[int, int], None]
Advance = Callable[[int], None]
"""Told how much of a unit is done, in the measure of its `size`."""

_TELLING_S = 0.5  # between what workers tell of their progress
_ALLOWED_DEATHS = 3  # of processes on this machine
_WORKER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    # Workers keep freed memory for the next block, up to these sizes in bytes; else the system clears it anew
    # for every array, which takes a quarter of the time.
    "MALLOC_TRIM_THRESHOLD_": str(1 << 28),
    "MALLOC_MMAP_THRESHOLD_": str(1 << 25),
}


@dataclass(frozen=True)
class Unit:
    """A piece of work that does not depend on any other of the same call."""

    key: str
    """Key of its result in the store."""
    arguments: tuple[Any, ...]
    size: int = 1
    """Amount of work, for the progress bar."""


@dataclass(frozen=True)
class WorkerPool:
    """Processes that run the units.

    Parameters
    ----------
    workers : int, optional
        Processes on this machine; as many as there are processors by default. 0: this process.
    progress : callable, optional
        Called with how much is done and how much there is in all.
    announce : callable, optional
        Called with a line of text that says what is done.

    Raises
    ------
    InputError
        For a number of workers that is no whole number from 0.
    """

    workers: int | None = None
    progress: Progress | None = None
    announce: Callable[[str], None] | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            workers = int(number_between("workers", self.workers, 0, 10_000, integer=True))
            object.__setattr__(self, "workers", workers)

    def say(self, text: str) -> None:
        """Announce a line of text."""
        if self.announce is not None:
            self.announce(text)


def in_stages(pool: WorkerPool, sizes: Sequence[int]) -> list[WorkerPool]:
    """Return a pool for each of several calls of `run_units`, with the progress of all of them together.

    Parameters
    ----------
    pool : WorkerPool
    sizes : sequence of int
        Expected amount of work of each call.
    """

    def part(before: int, size: int) -> WorkerPool:
        def progress(done: int, total: int) -> None:
            if pool.progress is not None:
                pool.progress(before + round(size * done / max(1, total)), sum(sizes))

        return replace(pool, progress=progress)

    return [part(sum(sizes[:number]), size) for number, size in enumerate(sizes)]


def run_units(
    function: Callable[..., Arrays], units: list[Unit], store: UnitStore, pool: WorkerPool
) -> Mapping[str, Arrays]:
    """Run the units whose results are not stored yet, store each as it finishes; return all results, by key.

    Results do not depend on where units run, in which order, or on interruptions.

    Parameters
    ----------
    function : callable
        Of a module, so that workers can import it. Called with a unit's arguments and, after them, a function
        that it tells from time to time how much it has done; returns what the store keeps.
    units : list of Unit
        Larger ones are begun first, so that no worker is left with one.
    store : UnitStore
    pool : WorkerPool

    Raises
    ------
    InputError
        When workers die repeatedly, or results cannot be written.
    """
    missing = sorted((unit for unit in units if not store.done(unit.key)), key=lambda unit: -unit.size)
    if missing:
        count = _Count(units, missing, pool.progress)
        for unit, result in _finished(function, missing, pool, count):
            store.write(unit.key, result)
            count.at(unit.key, unit.size)
    return _Stored(store, [unit.key for unit in units])


class _Stored(Mapping[str, Arrays]):
    """Results of units by key, read when they are asked for."""

    def __init__(self, store: UnitStore, keys: list[str]) -> None:
        self._store, self._keys = store, keys

    def __getitem__(self, key: str) -> Arrays:
        return self._store.read(key)

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)


Finished = Iterator[tuple[Unit, Arrays]]


class _Count:
    """Amount of finished work, in finished and unfinished units."""

    def __init__(self, units: list[Unit], missing: list[Unit], progress: Progress | None) -> None:
        self._whole = {unit.key: unit.size for unit in units}
        self._done = {**self._whole, **{unit.key: 0 for unit in missing}}
        self._progress = progress
        self._show()

    def at(self, key: str, done: int) -> None:
        """Note how far a unit is; what it does beyond what was expected does not count."""
        self._done[key] = max(self._done[key], min(done, self._whole[key]))
        self._show()

    def _show(self) -> None:
        if self._progress is not None:
            self._progress(sum(self._done.values()), sum(self._whole.values()))


def _finished(
    function: Callable[..., Arrays], units: list[Unit], pool: WorkerPool, count: _Count
) -> Finished:
    """Yield every unit and its result as it finishes."""
    if pool.workers == 0:
        return _here(function, units, count)
    processes = min(available_cpus() if pool.workers is None else pool.workers, len(units))
    pool.say(f"{processes} {'process' if processes == 1 else 'processes'} on this machine")
    return _by_processes(function, units, processes, count)


def _here(function: Callable[..., Arrays], units: list[Unit], count: _Count) -> Finished:
    for unit in units:
        yield unit, function(*unit.arguments, lambda done, key=unit.key: count.at(key, done))


def _by_processes(
    function: Callable[..., Arrays], units: list[Unit], processes: int, count: _Count
) -> Finished:
    """Let processes do the units; where one of them dies, new ones go on with what is left."""
    remaining = {unit.key: unit for unit in units}
    for deaths in range(1, _ALLOWED_DEATHS + 1):
        try:
            for key, result in _by_one_pool(function, list(remaining.values()), processes, count):
                yield remaining.pop(key), result
        except BrokenProcessPool:
            if deaths == _ALLOWED_DEATHS:
                raise InputError(
                    "processes died repeatedly, perhaps for lack of memory: what is finished is kept, try "
                    "fewer workers; a script must do this under if __name__ == '__main__':"
                ) from None
        else:
            return


def _by_one_pool(
    function: Callable[..., Arrays], units: list[Unit], processes: int, count: _Count
) -> Iterator[tuple[str, Arrays]]:
    # A process that was forked could not go on with the threads of this one.
    context = multiprocessing.get_context("spawn")
    news = context.SimpleQueue()
    earlier = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(processes, context, _begin_worker, (news,))
    pending: dict[Future[Arrays], str] = {}
    try:
        with _worker_environment():
            for unit in units:
                pending[pool.submit(_in_process, function, unit.key, unit.arguments)] = unit.key
            while pending:
                finished = wait(pending, _TELLING_S, FIRST_COMPLETED).done
                while not news.empty():
                    count.at(*news.get())
                for future in finished:
                    yield pending.pop(future), future.result()
    finally:
        if pending:  # an error, or the user has interrupted: nobody waits for these
            for child in set(multiprocessing.active_children()) - earlier:
                child.terminate()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Set what processes that are started meanwhile find in their environment, unless the user has."""
    added = {name: value for name, value in _WORKER_ENVIRONMENT.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


_news: Any = None
"""In a worker process: where it tells how far it is."""


def _begin_worker(news: Any) -> None:
    """Leave interruptions to the parent, and end with it."""
    global _news
    _news = news
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _in_process(function: Callable[..., Arrays], key: str, arguments: tuple[Any, ...]) -> Arrays:
    try:
        return function(*arguments, _seldom(lambda done: _news.put((key, done))))
    except ImportError as error:  # whose own kind cannot be sent to another process
        raise InputError(" ".join(str(error).split())) from None


def _seldom(tell: Advance) -> Advance:
    """Return a function that forwards progress at most a few times a second."""
    last = time.monotonic()

    def advance(done: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _TELLING_S:
            last = time.monotonic()
            tell(done)

    return advance


__all__ = ["Advance", "Progress", "Unit", "WorkerPool", "run_units"]
