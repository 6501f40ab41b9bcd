"""Running the units of an experiment over processes, and the store that remembers those that are finished."""

from __future__ import annotations

import hashlib
import json
import re
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from faintspot import __version__
from faintspot.checks import number_between
from faintspot.errors import InputError
from faintspot.loop.files import load_arrays, make_folder, save_arrays, write_atomically

Arrays = dict[str, NDArray[Any]]
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
Announce = Callable[[str], None]
Advance = Callable[[int], None]
"""Told how many frames a unit has simulated."""

_UNITS = "units"
_TELLING_S = 0.5  # between what workers tell of their progress


@dataclass(frozen=True)
class Unit:
    """A piece of work that does not depend on any other of the same call."""

    key: str
    """Names the file that its result is stored in."""
    arguments: tuple[Any, ...]
    frames: int = 1
    """About how many it simulates, for the progress."""


@dataclass(frozen=True)
class Workplace:
    """Where units are run.

    Parameters
    ----------
    workers : int, optional
        Processes on this machine; all processors by default. 0: this process, without Dask.
    scheduler : str, optional
        Address of a running Dask scheduler instead, such as "tcp://host:8786".
    progress : callable, optional
        Called with the number of frames simulated in this run and of all that are to be.
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
    announce: Announce | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            workers = int(number_between("workers", self.workers, 0, 10_000, integer=True))
            object.__setattr__(self, "workers", workers)

    def say(self, text: str) -> None:
        """Announce a line of text."""
        if self.announce is not None:
            self.announce(text)


class ResultStore(Protocol[Result]):
    """Where the results of units are."""

    def done(self, key: str) -> bool:
        """Return whether the result of a unit is there."""

    def read(self, key: str) -> Result:
        """Return the result of a unit."""

    def write(self, key: str, result: Result) -> None:
        """Store the result of a unit."""


class UnitStore:
    """Results of finished units, one file each, in the folder of an experiment.

    Parameters
    ----------
    folder : path
        Made where it is not there.
    kind : str
        Of the experiment; one folder may hold several kinds.
    identity : str
        Text of everything that its results depend on.
    overwrite : bool
        Whether the units of another experiment of this kind are deleted instead of refused.

    Raises
    ------
    InputError
        When the folder holds another experiment of this kind, or cannot be written.
    """

    def __init__(self, folder: str | Path, kind: str, identity: str, *, overwrite: bool = False) -> None:
        self.folder = make_folder(folder)
        self._units = make_folder(self.folder / _UNITS)
        self._kind = kind
        digest = hashlib.sha256(f"{__version__}\n{identity}".encode()).hexdigest()
        mark = self._units / f"{kind}.json"
        try:
            known = json.loads(mark.read_text(encoding="utf-8")).get("identity")
        except FileNotFoundError:
            known = None
        except (OSError, ValueError, AttributeError):
            known = "damaged"
        if known not in (None, digest) and not overwrite:
            raise InputError(
                f"{self.folder}: holds the {kind} experiment of another configuration or version: choose "
                "another folder, or --overwrite"
            )
        self.fresh = known != digest
        if self.fresh:
            for old in self._units.glob(f"{kind}-*.npz"):
                old.unlink(missing_ok=True)
            write_atomically(mark, (json.dumps({"identity": digest}) + "\n").encode())
        for remains in self._units.glob(".*.partial"):  # of a program that was killed while it wrote
            remains.unlink(missing_ok=True)

    def path(self, key: str) -> Path:
        """Return where the result of a unit is."""
        return self._units / f"{self._kind}-{re.sub('[^A-Za-z0-9_.-]', '_', key)}.npz"

    def done(self, key: str) -> bool:
        """Return whether the result of a unit is there."""
        return self.path(key).exists()

    def read(self, key: str) -> Arrays:
        """Return the result of a unit."""
        return load_arrays(self.path(key), "the result of a unit")

    def write(self, key: str, result: Arrays) -> None:
        """Store the result of a unit."""
        save_arrays(self.path(key), result)


def run_units(
    function: Callable[..., Result],
    units: list[Unit],
    store: ResultStore[Result],
    place: Workplace,
) -> dict[str, Result]:
    """Run the units whose results are not stored yet, store each as it finishes, and return all results.

    Results do not depend on where units run, in which order, or on interruptions.

    Parameters
    ----------
    function : callable
        Of a module, so that workers can import it. Called with a unit's arguments and, after them, a function
        that it tells from time to time how many frames it has simulated; returns what the store keeps.
    units : list of Unit
    store : ResultStore
    place : Workplace

    Raises
    ------
    InputError
        When the scheduler is not to be reached, workers die repeatedly, or results cannot be written.
    MissingExtraError
        When Dask is needed and not installed.
    """
    missing = [unit for unit in units if not store.done(unit.key)]
    missing.sort(key=lambda unit: -unit.frames)  # long ones first, so that no worker is left with one
    count = _Count(missing, place.progress)
    if place.workers == 0 and place.scheduler is None:
        for unit in missing:
            store.write(
                unit.key, function(*unit.arguments, lambda frames, key=unit.key: count.at(key, frames))
            )
            count.finished(unit.key)
    elif missing:
        for unit, result in _finished_by_workers(function, missing, place, count):
            store.write(unit.key, result)
            count.finished(unit.key)
    return {unit.key: store.read(unit.key) for unit in units}


class _Count:
    """How many frames are done, in units that are finished and in those that are not."""

    def __init__(self, units: list[Unit], progress: Progress | None) -> None:
        self._whole = {unit.key: unit.frames for unit in units}
        self._done = dict.fromkeys(self._whole, 0)
        self._progress = progress
        if units:
            self._show()

    def at(self, key: str, frames: int) -> None:
        """Note how far a unit is; what it does beyond what was expected does not count."""
        self._done[key] = max(self._done[key], min(frames, self._whole[key]))
        self._show()

    def finished(self, key: str) -> None:
        """Note that a unit is finished."""
        self.at(key, self._whole[key])

    def _show(self) -> None:
        if self._progress is not None:
            self._progress(sum(self._done.values()), sum(self._whole.values()))


def _finished_by_workers(
    function: Callable[..., Result], units: list[Unit], place: Workplace, count: _Count
) -> Iterator[tuple[Unit, Result]]:
    """Yield every unit and its result as it finishes."""
    from faintspot.study import running as study_running

    distributed = study_running.dask_distributed()
    topic = f"faintspot-loop-{uuid.uuid4()}"
    # What workers tell and finished units arrive here, so that all is told to the caller in its own thread.
    news: SimpleQueue[tuple[str, Any]] = SimpleQueue()
    with study_running.dask_client(place.scheduler, place.workers, len(units)) as client:
        place.say(f"Dask scheduler {client.scheduler.address}{study_running.dashboard(client)}")
        client.subscribe_topic(topic, lambda event: news.put(event[1]))
        waiting = {unit.key: unit for unit in units}
        futures = {}
        for unit in units:
            future = client.submit(_on_worker, function, unit, topic, __version__, pure=False)
            futures[unit.key] = future
            future.add_done_callback(lambda done, key=unit.key: news.put((key, done)))
        try:
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


def _on_worker(function: Callable[..., Result], unit: Unit, topic: str, version: str) -> Result:
    """Run a unit where the code is the same as where the experiment was started."""
    import distributed

    if version != __version__:
        raise InputError("a worker has another version of faintspot: install the same on all")
    worker, told = distributed.get_worker(), time.monotonic()

    def tell(frames: int) -> None:
        nonlocal told
        if time.monotonic() - told >= _TELLING_S:
            told = time.monotonic()
            worker.log_event(topic, (unit.key, frames))

    return function(*unit.arguments, tell)
