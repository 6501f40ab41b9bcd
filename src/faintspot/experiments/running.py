"""Running units of work over processes of this machine, or over a Dask cluster that the user has started.

Work on this machine opens no port: processes talk through pipes that nobody else can reach.
"""

from __future__ import annotations

import importlib
import importlib.util
import multiprocessing
import os
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from queue import SimpleQueue
from typing import Any

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.version import __version__
from faintspot.experiments.store import Arrays, UnitStore
from faintspot.kernels.parallel import available_cpus

Progress = Callable[[int, int], None]
Advance = Callable[[int], None]
"""Told how much of a unit is done, in the measure of its `size`."""

_CONNECT_TIMEOUT_S = 10
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
    """Processes or cluster that run the units.

    Parameters
    ----------
    workers : int, optional
        Processes on this machine; as many as there are processors by default. 0: this process.
    scheduler : str, optional
        Address of a running Dask scheduler instead, such as "tcp://host:8786", whose workers have the same
        version of faintspot. Anyone who can reach it can run anything as the user of its workers: see
        docs/study.md for one that only you reach.
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
    scheduler: str | None = None
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


def in_stages(place: WorkerPool, sizes: Sequence[int]) -> list[WorkerPool]:
    """Return a place for each of several calls of `run_units`, with the progress of all of them together.

    Parameters
    ----------
    place : WorkerPool
    sizes : sequence of int
        Expected amount of work of each call.
    """

    def part(before: int, size: int) -> WorkerPool:
        def progress(done: int, total: int) -> None:
            if place.progress is not None:
                place.progress(before + round(size * done / max(1, total)), sum(sizes))

        return replace(place, progress=progress)

    return [part(sum(sizes[:number]), size) for number, size in enumerate(sizes)]


def run_units(
    function: Callable[..., Arrays], units: list[Unit], store: UnitStore, place: WorkerPool
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
    place : WorkerPool

    Raises
    ------
    InputError
        When the scheduler is not to be reached, workers die repeatedly, or results cannot be written.
    MissingExtraError
        When Dask is needed and not installed.
    """
    missing = sorted((unit for unit in units if not store.done(unit.key)), key=lambda unit: -unit.size)
    if missing:
        count = _Count(units, missing, place.progress)
        for unit, result in _finished(function, missing, place, count):
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
    function: Callable[..., Arrays], units: list[Unit], place: WorkerPool, count: _Count
) -> Finished:
    """Yield every unit and its result as it finishes."""
    if place.scheduler is not None:
        return _by_dask(function, units, place, place.scheduler, count)
    if place.workers == 0:
        return _here(function, units, count)
    processes = min(available_cpus() if place.workers is None else place.workers, len(units))
    place.say(f"{processes} {'process' if processes == 1 else 'processes'} on this machine")
    return _by_processes(function, units, processes, count)


def _here(function: Callable[..., Arrays], units: list[Unit], count: _Count) -> Finished:
    for unit in units:
        yield unit, function(*unit.arguments, lambda done, key=unit.key: count.at(key, done))


# Processes of this machine --------------------------------------------------------------------------------


def _by_processes(
    function: Callable[..., Arrays], units: list[Unit], processes: int, count: _Count
) -> Finished:
    """Let processes do the units; where one of them dies, new ones go on with what is left."""
    left = {unit.key: unit for unit in units}
    for deaths in range(1, _ALLOWED_DEATHS + 1):
        try:
            for key, result in _by_one_pool(function, list(left.values()), processes, count):
                yield left.pop(key), result
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
    others = set(multiprocessing.active_children())
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
            for child in set(multiprocessing.active_children()) - others:
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
    told = time.monotonic()

    def advance(done: int) -> None:
        nonlocal told
        if time.monotonic() - told >= _TELLING_S:
            told = time.monotonic()
            tell(done)

    return advance


# A Dask cluster -------------------------------------------------------------------------------------------


def _by_dask(
    function: Callable[..., Arrays], units: list[Unit], place: WorkerPool, scheduler: str, count: _Count
) -> Finished:
    """Let a running cluster do the units."""
    distributed = _distributed()
    topic = f"faintspot-{uuid.uuid4()}"
    # What workers tell and finished units arrive here, so that all is told to the caller in its own thread.
    news: SimpleQueue[tuple[str, Any]] = SimpleQueue()
    with _connected(distributed, scheduler) as client:
        place.say(f"Dask scheduler {client.scheduler.address}{_dashboard(client)}")
        client.subscribe_topic(topic, lambda event: news.put(event[1]))
        waiting, futures = {unit.key: unit for unit in units}, dict[str, Any]()
        try:
            for unit in units:
                future = client.submit(
                    _on_worker, function, unit.key, unit.arguments, topic, __version__, pure=False
                )
                futures[unit.key] = future
                future.add_done_callback(lambda done, key=unit.key: news.put((key, done)))
            while waiting:
                key, what = news.get()
                if isinstance(what, int):
                    count.at(key, what)
                else:
                    yield waiting.pop(key), futures.pop(key).result()
        except distributed.KilledWorker as error:
            raise InputError(f"workers died repeatedly, perhaps of lack of memory: {error}") from None
        finally:
            client.cancel(list(futures.values()))


def _on_worker(
    function: Callable[..., Arrays], key: str, arguments: tuple[Any, ...], topic: str, version: str
) -> Mapping[str, Any]:
    """Run a unit where the code is the same as where the experiment was started."""
    import distributed

    if version != __version__:
        raise InputError("a worker has another version of faintspot: install the same on all")
    worker = distributed.get_worker()
    return function(*arguments, _seldom(lambda done: worker.log_event(topic, (key, done))))


def _distributed() -> Any:
    """Return the module, of which only a part is typed."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise MissingExtraError("dask[distributed]", "study", "A Dask scheduler") from None


@contextmanager
def _connected(distributed: Any, scheduler: str) -> Iterator[Any]:
    """Connect to a running scheduler; never as Dask's default, which what else the process does would use."""
    certificates = distributed.Security().get_connection_args("client").get("ssl_context")
    if scheduler.startswith("tls:") and certificates is None:
        raise InputError(
            f"scheduler = {scheduler!r}: expected certificates in Dask's configuration, found none; "
            "docs/study.md says how to give them"
        )
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"scheduler = {scheduler!r}: cannot be reached, expected an address such as "
            f"tcp://host:8786 ({' '.join(str(error).split())})"
        ) from None
    with client:
        yield client


def _dashboard(client: Any) -> str:
    """Return where the dashboard is; without Bokeh, which draws it, Dask links to a missing page."""
    link = client.dashboard_link
    return f", dashboard {link}" if link and importlib.util.find_spec("bokeh") else ""


__all__ = ["Advance", "Progress", "Unit", "WorkerPool", "run_units"]
