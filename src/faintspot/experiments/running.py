"""Running units of work with joblib: in processes of this machine, or on a running Dask cluster.

Work on this machine opens no network port.
"""

import os
import platform
import signal
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base import __version__
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError, require
from faintspot.experiments.store import Arrays, UnitStore
from faintspot.slopes.estimators.registry import estimators, register
from faintspot.slopes.kernels.parallel import available_cpus

Progress = Callable[[int, int], None]
Advance = Callable[[int], None]
"""Called with the finished part of a unit, in the measure of its `size`."""

_LOOK_S = 0.5  # between looks at how far workers are
_ATTEMPTS = 3  # where workers die or a connection is lost
_CONNECT_S = 10
_VERSION = f"faintspot {__version__} on Python {platform.python_version()}"


@dataclass(frozen=True)
class Unit:
    """A piece of work that does not depend on any other of the same call."""

    key: str
    """Key of its result in the store."""
    arguments: tuple[object, ...]
    size: int = 1
    """Amount of work, for the progress bar."""


@dataclass(frozen=True)
class WorkerPool:
    """Processes or cluster that run the units.

    Parameters
    ----------
    workers : int, optional
        Processes on this machine; as many as there are processors by default. 0 or 1: this process.
    progress : callable, optional
        Called with how much is done and how much there is in all, also from another thread.
    announce : callable, optional
        Called with a line of text that says what is done.
    scheduler : str, optional
        Address of a running Dask scheduler instead, such as "tls://host:8786". Anyone who can reach it can
        run code as the user of its workers: see docs/cluster.md.

    Raises
    ------
    InputError
        For a number of workers that is no whole number from 0.
    MissingExtraError
        For a scheduler where Dask is not installed.

    Examples
    --------
    >>> from faintspot.experiments import WorkerPool
    >>> pool = WorkerPool(workers=2, announce=print)
    >>> pool.say("scoring")
    scoring
    """

    workers: int | None = None
    progress: Progress | None = None
    announce: Callable[[str], None] | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            workers = int(number_between("workers", self.workers, 0, 10_000, integer=True))
            object.__setattr__(self, "workers", workers)
        if self.scheduler is not None:
            require("cluster", "distributed", purpose="A Dask scheduler")

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
) -> UnitStore:
    """Run the units whose results are not stored yet, and store each as it finishes; return the store.

    Results do not depend on where units run, in which order, or on interruptions.

    Parameters
    ----------
    function : callable
        Called with a unit's arguments and, after them, a function that it tells from time to time how much
        it has done; returns what the store keeps.
    units : list of Unit
        Larger ones are begun first, so that no worker is left with one.
    store : UnitStore
    pool : WorkerPool

    Raises
    ------
    InputError
        When workers die repeatedly, the scheduler cannot be reached, or results cannot be written.
    """
    missing = sorted((unit for unit in units if unit.key not in store), key=lambda unit: -unit.size)
    if missing:
        count = _Count(missing, sum(unit.size for unit in units), pool.progress)
        for number, result in _finished(function, dict(enumerate(missing)), pool, count):
            store[missing[number].key] = result
            count.at(number, missing[number].size)
    return store


class _Count:
    """Amount of finished work, in finished and unfinished units."""

    def __init__(self, missing: list[Unit], total: int, progress: Progress | None) -> None:
        self._sizes, self._total, self._progress = np.array([u.size for u in missing]), total, progress
        self.done, self._lock = np.zeros_like(self._sizes), threading.Lock()
        self.at(slice(None), 0)

    def at(self, unit: int | slice, done: ArrayLike) -> None:
        """Note how far a unit is, or all; what it does beyond what was expected does not count."""
        with self._lock:
            self.done[unit] = np.clip(done, self.done[unit], self._sizes[unit])
            if self._progress is not None:
                self._progress(self._total - int((self._sizes - self.done).sum()), self._total)


def _finished(
    function: Callable[..., Arrays], units: dict[int, Unit], pool: WorkerPool, count: _Count
) -> Iterator[tuple[int, Arrays]]:
    """Yield the number of every unit and its result as it finishes; go on where workers are lost."""
    processes = min(available_cpus() if pool.workers is None else pool.workers, len(units))
    if pool.scheduler is None and processes < 2:
        for number, unit in units.items():
            yield number, function(*unit.arguments, lambda done, number=number: count.at(number, done))
        return
    for _ in range(_ATTEMPTS):
        try:
            for number, result in _by_joblib(function, units, processes, pool, count):
                del units[number]
                yield number, result
            return
        except BrokenProcessPool as error:
            reason = str(error)
    raise InputError(
        f"workers were lost repeatedly, perhaps for lack of memory: what is finished is kept ({reason})"
    )


def _by_joblib(
    function: Callable[..., Arrays], units: dict[int, Unit], processes: int, pool: WorkerPool, count: _Count
) -> Iterator[tuple[int, Arrays]]:
    require("loop", "joblib", purpose="Work in several processes")
    from joblib import Parallel, delayed, parallel_config

    how = {"return_as": "generator_unordered", "batch_size": 1}
    with ExitStack() as stack:
        if pool.scheduler is not None:
            backend, progress_file = stack.enter_context(_cluster(pool.scheduler, pool.say)), None
            parallel = Parallel(backend=backend, pre_dispatch="all", **how)
        else:
            pool.say(f"{processes} processes on this machine")
            progress_file = stack.enter_context(_followed(count))
            with parallel_config("loky", inner_max_num_threads=1, initializer=_begin, initargs=[os.getpid()]):
                parallel = Parallel(processes, **how)
        own = [kind for kind in estimators().values() if not kind.__module__.startswith("faintspot.")]
        # In tuples: other large arguments would stay with one worker, and be lost with it.
        results = parallel(
            delayed(_in_worker)((function, unit.arguments), (number, progress_file), (own, _VERSION))
            for number, unit in list(units.items())
        )
        try:
            for result in results:  # noqa: UP028 - `yield from` would close them before what follows
                yield result
        finally:
            with warnings.catch_warnings(action="ignore"):  # about results that nobody takes
                results.close()


def _in_worker(work: tuple[Any, ...], place: tuple[int, Path | None], package: tuple[Any, ...]) -> object:
    """Run a unit with the estimators that are registered where the experiment was started."""
    (function, arguments), (number, progress_file), (own, version) = work, place, package
    if version != _VERSION:
        raise InputError(f"a worker has {_VERSION}, expected {version}: install the same ones everywhere")
    for kind in own:
        register(kind)
    done = np.zeros(number + 1) if progress_file is None else np.load(progress_file, mmap_mode="r+")
    try:
        return number, function(*arguments, lambda amount: done.__setitem__(number, amount))
    except ImportError as error:  # whose own kind cannot be sent to another process
        raise InputError(" ".join(str(error).split())) from None


def _begin(parent: int) -> None:
    """Leave interruptions to the parent, and end with it: joblib would go on with what is queued."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _followed(count: _Count) -> Iterator[Path]:
    """Follow how far workers on this machine are, which they write into the file that this yields."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        path, ended = Path(folder) / "done.npy", threading.Event()
        np.save(path, count.done)
        done = np.load(path, mmap_mode="r")

        def follow() -> None:
            while not ended.wait(_LOOK_S):
                count.at(slice(None), done)

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield path
        finally:
            ended.set()
            thread.join()


@contextmanager
def _cluster(scheduler: str, say: Callable[[str], None]) -> Iterator[object]:
    """Connect to a running scheduler; yield joblib's backend, which alone waits forever for lost workers."""
    import distributed
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):  # type: ignore[misc]
        def effective_n_jobs(self, n_jobs: int) -> int:
            # Of 1, from a cluster with one thread so far, joblib would run all units in this process.
            return max(2, int(super().effective_n_jobs(n_jobs)))

        def submit(self, func: object, callback: Any = None) -> object:
            future = super().submit(func, callback)
            future.add_done_callback(lambda done: done.exception() and callback(done.exception()))
            return future

        def retrieve_result_callback(self, out: object) -> object:
            if isinstance(out, BaseException):  # Dask's own, not a unit's
                raise BrokenProcessPool(str(out))
            return super().retrieve_result_callback(out)

    try:  # never as Dask's default, which what else the process does would use
        client = distributed.Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        raise InputError(
            f"scheduler = {scheduler!r}: cannot be reached, expected an address such as tcp://host:8786, or "
            f"tls:// with certificates in Dask's configuration ({error})"
        ) from None
    with client:
        say(f"Dask scheduler {scheduler}, when its first worker is there")
        client.wait_for_workers(1)
        yield Backend(client=client)
