"""Streams that other programs publish, by name: pyshmem's NAME, ImageStreamIO's isio:NAME, dao's dao:FILE."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.realtime.image_layout import DAO, ISIO, IncompatibleStreamError, path_of
from faintspot.realtime.image_stream import ImageStream
from faintspot.realtime.publication import LARGEST_NUMBER, Publication
from faintspot.realtime.shared_streams import lock_file, pyshmem_module

_NAP_S = 5e-4


class Stream(Protocol):
    """A stream as it is followed; all its numbers change as others write."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def count(self) -> int:
        """How much was published."""

    @property
    def number(self) -> int:
        """Number of the newest."""

    @property
    def maker(self) -> str:
        """Who made it."""

    def maker_lives(self) -> bool | None:
        """Whether that process is there; None where it is not known."""

    def same(self) -> bool | None:
        """Whether the name still leads here; None where it leads nowhere."""

    def wait(self, after: int, limit_s: float) -> bool:
        """Wait until more was published than `after`, at most so long; return whether there was."""

    def read(self, out: NDArray[Any] | None = None, limit_s: float = 0.0) -> Publication | None:
        """Return the newest publication, or None when none is whole within the time."""

    def close(self) -> None:
        """Let go."""


class PyshmemStream:
    """A stream of pyshmem; see `Stream`. A number that its producer does not set is the count less one.

    Raises
    ------
    FileNotFoundError
        When there is none.
    IncompatibleStreamError
        When it cannot be opened.
    InputError
        When the folder of pyshmem's locks is not private.
    """

    def __init__(self, name: str) -> None:
        self._pyshmem: Any = pyshmem_module("reading a stream in shared memory")
        lock_file(name)  # refuses a place that is not private, in which pyshmem makes one
        try:
            # Not read-only: pyshmem leaves it to readers to mark what a writer that died has left half
            # written, and without that its successor's frames cannot be told from torn ones.
            self._source = self._pyshmem.open(name, gpu_device=False)
        except FileNotFoundError:
            raise
        except (OSError, ValueError) as error:  # half made, or not for us
            raise IncompatibleStreamError(f"cannot be opened ({' '.join(str(error).split())})") from None
        self._name = name
        self.shape, self.dtype = tuple(self._source.shape), self._source.dtype

    @property
    def count(self) -> int:
        """See `Stream`."""
        return int(self._source.count)

    @property
    def number(self) -> int:
        """See `Stream`."""
        return _number(self._source.frame_id, self._source.count)

    @property
    def maker(self) -> str:
        """See `Stream`."""
        return f"pid {self._source.creator_pid}"

    def maker_lives(self) -> bool:
        """See `Stream`."""
        return bool(self._source.producer_alive())

    def same(self) -> bool | None:
        """See `Stream`."""
        try:
            return bool(self._pyshmem.stat(self._name)["instance_id"] == self._source.instance_id)
        except (OSError, ValueError):
            return None

    def wait(self, after: int, limit_s: float) -> bool:
        """See `Stream`; streams made with ``notify=True`` wake it, others are looked at."""
        source = self._source
        try:
            source.wait_for_count(after=after, timeout=limit_s, poll_interval=_NAP_S)
        except TimeoutError:
            return False
        except self._pyshmem.InconsistentStreamError:
            time.sleep(limit_s)  # a writer died in the middle: there may come another
            return bool(source.count != after)
        return True

    def read(self, out: NDArray[Any] | None = None, limit_s: float = 0.0) -> Publication | None:
        """See `Stream`."""
        try:
            publication = self._source.read_publication(out=out, timeout=limit_s)
        except (TimeoutError, self._pyshmem.InconsistentStreamError):
            return None
        number = _number(publication.frame_id, publication.count)
        return Publication(publication.payload, number, publication.count)

    def close(self) -> None:
        """See `Stream`."""
        self._source.close()


def _number(frame_id: int, count: int) -> int:
    """Return a publication's frame number; of a writer that stamps nothing, frame_id is 0."""
    return (frame_id or max(count - 1, 0)) & LARGEST_NUMBER


def split_name(name: str) -> tuple[str, str]:
    """Return kind ("isio", "dao" or "" for pyshmem) and the name without it."""
    kind, separator, rest = name.partition(":")
    return (kind, rest) if separator and kind in (ISIO, DAO) else ("", name)


def check_stream(name: str) -> None:
    """Refuse a name that no stream can have, or one of pyshmem's without pyshmem.

    Raises
    ------
    InputError, MissingExtraError
        One line.
    """
    kind, rest = split_name(name)
    if kind:
        path_of(kind, rest)
    else:
        pyshmem_module("reading a stream in shared memory")


def open_stream(name: str) -> Stream:
    """Open a stream of any kind.

    Raises
    ------
    FileNotFoundError
        When there is none of that name.
    IncompatibleStreamError
        When there is something else, with the reason.
    """
    kind, rest = split_name(name)
    if kind:
        try:
            return ImageStream(kind, rest)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise IncompatibleStreamError(f"cannot be opened ({error.strerror})") from None
    return PyshmemStream(name)


class Follower:
    """Follows a stream by its name, which may be missing, hold something else, go away and come back.

    Parameters
    ----------
    name : str
    say : function
        Told in one line what happens to the stream.
    incompatible : function
        Takes shape and type; returns why that is not what is wanted, "" where it is.
    meanwhile : function
        Returns what is done without a stream, for `say`.

    Attributes
    ----------
    source : Stream or None
    obstacle : str
        Why there is none, "" where there is.
    """

    def __init__(
        self,
        name: str,
        say: Callable[[str], None],
        incompatible: Callable[[tuple[int, ...], np.dtype[Any]], str],
        meanwhile: Callable[[], str],
    ) -> None:
        check_stream(name)
        self.name, self._say, self._incompatible, self._meanwhile = name, say, incompatible, meanwhile
        self.source: Stream | None = None
        self.obstacle = ""

    def say(self, text: str) -> None:
        """Say what happens to the stream."""
        self._say(f"stream {self.name}: {text}")

    def open(self) -> Stream | None:
        """Open the stream; None where something stands in the way, which is said once."""
        obstacle = self._opened()
        if obstacle and obstacle != self.obstacle:
            self.say(f"{obstacle}; {self._meanwhile()}")
        self.obstacle = obstacle
        return self.source

    def _opened(self) -> str:
        """Return what stands in the way."""
        try:
            source = open_stream(self.name)
        except FileNotFoundError:
            return "is not there"
        except IncompatibleStreamError as error:
            return str(error)
        obstacle = self._incompatible(source.shape, source.dtype)
        if obstacle:
            source.close()
            return f"holds {source.shape} {source.dtype}, expected {obstacle}"
        self.source = source
        return ""

    def lost(self) -> str:
        """Let go of a stream that is not there any more; return in words what happened, "" for nothing."""
        same = self.source.same() if self.source is not None else True
        if same:
            return ""
        self.close()
        return "was removed" if same is None else "was made anew"

    def close(self) -> None:
        """Let go of the stream."""
        if self.source is not None:
            self.source.close()
            self.source = None
