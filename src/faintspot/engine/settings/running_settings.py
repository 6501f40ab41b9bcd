"""Settings that change while the engine runs: checked and prepared meanwhile, applied between two frames."""

import copy
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError
from faintspot.base.options import PerSubaperture
from faintspot.base.text_files import check_known
from faintspot.slopes.estimators.built_in.weighted import Stepping
from faintspot.slopes.pipeline.settings import Settings, check_option, option_names
from faintspot.slopes.sensor.layout import Layout

HISTORY_LENGTH = 1000
"""Number of changes that are remembered."""
_POLL_S = 0.001


class HasSettings(Protocol):
    """Object made from settings: a `SlopePipeline` or an engine's `EnginePlan`."""

    @property
    def settings(self) -> Settings:
        """Settings from which it was made."""
        ...

    @property
    def layout(self) -> Layout:
        """Layout of its sensor."""
        ...


Prepared = TypeVar("Prepared", bound=HasSettings)


@dataclass(slots=True, eq=False)
class Change:
    """A change of settings that was accepted."""

    number: int
    """Number of the change, from 1."""
    changes: dict[str, Any]
    """New values by name."""
    where: list[int] | None
    """Sub-apertures that it applies to; None: all."""
    frame_number: int | None = None
    """First frame measured with it; None while it waits, or if a later change replaced it before."""


@dataclass(frozen=True, slots=True, eq=False)
class _Version(Generic[Prepared]):
    """Prepared settings, and the last change that they include."""

    prepared: Prepared
    change: Change


class RunningSettings(Generic[Prepared]):
    """The running settings of an engine, and the changes that wait for the next frame.

    Any thread may propose changes; they are checked and prepared there. Between two frames the engine's
    thread takes the latest prepared settings: it reads one attribute and never blocks. No change is lost:
    each one builds on all earlier ones, whether they are running already or not.

    Parameters
    ----------
    prepare : function
        Prepares settings for the first frame; raises InputError for settings that do not fit. Called by one
        thread at a time.
    settings : Settings
        Initial settings.

    Raises
    ------
    InputError
        When the initial settings do not fit.
    """

    def __init__(self, prepare: Callable[[Settings], Prepared], settings: Settings) -> None:
        self._prepare = prepare
        # `take` takes neither of them.
        self._proposing = threading.Lock()  # held while settings are prepared, which may take seconds
        self._lock = threading.Lock()  # for the history and the newest settings
        self._under_way: tuple[dict[str, object], float] | None = None
        first = _Version(prepare(settings), Change(0, {}, None, frame_number=-1))
        # Written with `_lock` held; read by the engine.
        self._newest = first
        # Written by the engine alone.
        self._running = first
        self._replaced: deque[_Version[Prepared]] = deque()
        self._record: deque[Change] = deque(maxlen=HISTORY_LENGTH)

    # The engine's thread ----------------------------------------------------------------------------

    def take(self, frame_number: int) -> Prepared:
        """Return the latest prepared settings, with which frame `frame_number` is to be measured.

        Call it from one thread, between two frames. The changes that it includes are stamped with that
        number.
        """
        newest = self._newest  # read once: later changes wait for the next frame
        if newest is not self._running:
            newest.change.frame_number = frame_number
            self._replaced.append(self._running)  # another thread frees its memory
            self._running = newest
        return newest.prepared

    # Any thread -------------------------------------------------------------------------------------

    @property
    def running(self) -> Prepared:
        """The settings that measure frames now, prepared."""
        return self._running.prepared

    @property
    def newest(self) -> Prepared:
        """The latest prepared settings, whether the engine has taken them or not."""
        return self._newest.prepared

    @property
    def settings(self) -> Settings:
        """The running settings."""
        return self._running.prepared.settings

    def let_go(self) -> None:
        """Free replaced settings, which takes time; for any thread but the engine's."""
        self._replaced.clear()

    def propose(self, changes: Mapping[str, object], where: Sequence[int] | None = None) -> Change:
        """Check a change as a whole and prepare it, for the engine to take before its next frame.

        Parameters
        ----------
        changes : mapping
            New values by name.
        where : sequence of int, optional
            Indices of the sub-apertures to change, from 0. Default: all.

        Returns
        -------
        Change
            `frame_of` and `wait` return when it took effect.

        Raises
        ------
        InputError
            When something does not fit; nothing changes then.
        """
        if not isinstance(changes, Mapping) or not changes:
            raise InputError(
                f"settings: expected new values by name, such as search_range_px, got {changes!r:.40}"
            )
        check_names(list(changes))
        with self._proposing:
            newest = self._newest.prepared
            layout = newest.layout
            indices = None if where is None else _checked_indices(where, len(layout))
            settings = newest.settings.replace(where=indices, **changes)
            for name in settings.declared():  # including options that the estimator does not use at present
                settings.values(name, len(layout), layout.pixels)
            return self._offered(settings, copy.deepcopy(dict(changes)), indices)

    def renew(self, changes: Mapping[str, object]) -> Change:
        """Prepare the same settings again because something else has changed, named in `changes`.

        Raises
        ------
        InputError
            When they cannot be prepared; nothing changes then.
        """
        with self._proposing:
            return self._offered(self._newest.prepared.settings, dict(changes), None)

    @property
    def preparing(self) -> dict[str, Any] | None:
        """Settings being prepared: new values by name, and seconds so far; None if there are none."""
        under_way = self._under_way
        if under_way is None:
            return None
        changes, begin = under_way
        return {"changes": copy.deepcopy(changes), "seconds": time.monotonic() - begin}

    def _offered(self, settings: Settings, changes: dict[str, Any], where: list[int] | None) -> Change:
        """Prepare settings and offer them to the engine; for the thread that proposes."""
        self._under_way = changes, time.monotonic()
        try:
            prepared = self._prepare(settings)
        finally:
            self._under_way = None
        change = self.offer(prepared, changes, where)
        self.let_go()
        return change

    def offer(self, prepared: Prepared, changes: dict[str, Any], where: list[int] | None = None) -> Change:
        """Offer prepared settings to the engine for its next frame; `changes` names the new values."""
        with self._lock:
            change = Change(self._newest.change.number + 1, changes, where)
            self._record.append(change)
            self._newest = _Version(prepared, change)
        return change

    def frame_of(self, change: Change) -> int | None:
        """Return the first frame with a change; None while it waits, or if it is no longer in the history."""
        with self._lock:
            if self._record and change.number < self._record[0].number:
                return change.frame_number
            later = takewhile(lambda accepted: accepted.number >= change.number, reversed(self._record))
            frames = [accepted.frame_number for accepted in later if accepted.frame_number is not None]
        return frames[-1] if frames else None

    def wait(self, change: Change, timeout_s: float = 1.0) -> int | None:
        """Wait until the engine has taken a change; return its frame, or None on timeout."""
        end = time.monotonic() + timeout_s
        while (frame_number := self.frame_of(change)) is None and time.monotonic() < end:
            time.sleep(_POLL_S)
        return frame_number

    def taken(self, after: int = 0) -> list[tuple[int, int, dict[str, Any], list[int] | None]]:
        """Return the changes that took effect: frame number, number, new values, sub-apertures.

        Oldest first; only changes with a number above `after`.
        """
        if after == self.change_number:
            return []
        taken: list[tuple[int, int, dict[str, object], list[int] | None]] = []
        with self._lock:
            frame_number = None
            for change in takewhile(lambda entry: entry.number > after, reversed(self._record)):
                # A replaced change took effect with the next one that was taken.
                frame_number = frame_number if change.frame_number is None else change.frame_number
                if frame_number is not None:
                    values, where = copy.deepcopy(change.changes), copy.copy(change.where)
                    taken.append((frame_number, change.number, values, where))
        return taken[::-1]

    @property
    def change_number(self) -> int:
        """Number of the last running change; 0 before the first."""
        return self._running.change.number

    def get(self, names: Sequence[str] | None = None) -> dict[str, Any]:
        """Return running values by name (default: all) as plain numbers, texts and lists.

        Defaults are filled in. A setting that differs between sub-apertures is a list with one value for
        each. None means not used, not limited, or not a fixed number: found from the PSF or from each frame's
        flux.

        Raises
        ------
        InputError
            When a name is unknown, or of another estimator than the configured one.
        """
        running = self.running
        n, pixels = len(running.layout), running.layout.pixels
        settings = running.settings
        check_names(names)
        for name in names or ():
            if name not in ("estimator", *Settings.SHARED):
                check_option(name, type(settings.estimator))
        asked_names = names or ["estimator", *settings.declared()]
        return {name: _plain(settings, name, n, pixels) for name in asked_names}


def check_names(names: Sequence[str] | None) -> None:
    """Check that the names are a list of options of any estimator.

    Raises
    ------
    InputError
        When a name is unknown.
    """
    if names is not None and (isinstance(names, str) or not isinstance(names, Sequence)):
        raise InputError(f"names = {names!r}: expected a list of settings' names")
    for name in names or ():
        check_known("settings.", str(name), option_names(), "option")


def _checked_indices(where: Sequence[int], n: int) -> list[int]:
    """Return the indices of sub-apertures as plain ints, after checking that they exist."""
    array = numbers_between("where", where, 0, integer=True)
    if array.ndim != 1:
        raise InputError(f"where: expected a list of sub-apertures, got shape {array.shape}")
    if array.max() >= n:
        raise InputError(f"where: sub-aperture {array.max()} does not exist; there are {n}, counted from 0")
    return [int(index) for index in array]


def _plain(settings: Settings, name: str, n: int, pixels: int) -> object:
    """Return a setting as plain values, with its default filled in."""
    value = settings.estimator.name if name == "estimator" else getattr(settings, name)
    if name == "steps" and isinstance(settings.estimator, Stepping):
        return settings.estimator.step_count
    differs = isinstance(value, PerSubaperture | np.ndarray)
    if value is not None and not differs:
        return value
    items = settings.values(name, n, pixels).tolist()
    values = [None if isinstance(item, float) and math.isnan(item) else item for item in items]
    return values if differs else values[0]
