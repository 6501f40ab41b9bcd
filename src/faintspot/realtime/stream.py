"""Streams that other programs publish: pyshmem's NAME, ImageStreamIO's isio:NAME, dao's dao:FILE."""

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
    """Interface of a stream that another program writes; its properties change with each publication."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def count(self) -> int:
        """Number of publications."""

    @property
    def number(self) -> int:
        """Number of the newest frame."""

    @property
    def maker(self) -> str:
        """Process that made the stream, in words."""

    def maker_lives(self) -> bool | None:
        """Return whether that process is alive; None if it is not known."""

    def same(self) -> bool | None:
        """Return whether the name still leads to this stream; None if it leads nowhere."""

    def wait(self, after: int, limit_s: float) -> bool:
        """Wait up to `limit_s` until more than `after` publications exist; return whether they do."""

    def read(self, out: NDArray[Any] | None = None, limit_s: float = 0.0) -> Publication | None:
        """Return the newest publication, or None when no complete one can be read in time."""

    def close(self) -> None:
        """Close the stream."""


class PyshmemStream:
    """A pyshmem stream; see `Stream`. Without a `frame_id`, the frame number is the count minus one.

    Raises
    ------
    FileNotFoundError
        When the stream does not exist.
    IncompatibleStreamError
        When it cannot be opened.
    InputError
        When pyshmem's lock folder is not private.
    """

    def __init__(self, name: str) -> None:
        self._pyshmem: Any = pyshmem_module("reading a stream in shared memory")
        lock_file(name)  # refuses a folder that is not private
        try:
            # Not read-only: readers have to mark what a dead writer left incomplete; otherwise pyshmem cannot
            # tell its successor's frames from torn ones.
            self._source = self._pyshmem.open(name, gpu_device=False)
        except FileNotFoundError:
            raise
        except (OSError, ValueError) as error:  # incomplete, or not accessible
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
        """See `Stream`; streams made with ``notify=True`` wake the reader, others are polled."""
        source = self._source
        try:
            source.wait_for_count(after=after, timeout=limit_s, poll_interval=_NAP_S)
        except TimeoutError:
            return False
        except self._pyshmem.InconsistentStreamError:
            time.sleep(limit_s)  # the writer died while writing: another may come
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
    """Return a publication's frame number; `frame_id` is 0 if the writer sets none."""
    return (frame_id or max(count - 1, 0)) & LARGEST_NUMBER


def split_name(name: str) -> tuple[str, str]:
    """Return the kind ("isio", "dao" or "" for pyshmem) and the name without it."""
    kind, separator, rest = name.partition(":")
    return (kind, rest) if separator and kind in (ISIO, DAO) else ("", name)


def check_stream(name: str) -> None:
    """Check that a stream can have that name, and that pyshmem is installed if it is needed.

    Raises
    ------
    InputError, MissingExtraError
        When it cannot, or pyshmem is missing.
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
        When no stream has that name.
    IncompatibleStreamError
        When it is not a usable stream; the text gives the reason.
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
    """Connection to a stream by its name: it may be missing, unusable, removed and recreated.

    Parameters
    ----------
    name : str
    say : function
        Called with a one-line message when the stream changes.
    incompatible : function
        Takes shape and type; returns what was expected instead, "" if they fit.
    meanwhile : function
        Returns what is done without a stream, for messages.

    Attributes
    ----------
    source : Stream or None
    obstacle : str
        Why there is no stream; "" if there is one.
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
        """Report a change of the stream."""
        self._say(f"stream {self.name}: {text}")

    def open(self) -> Stream | None:
        """Open the stream; return None if that fails, and report the reason once."""
        obstacle = self._opened()
        if obstacle and obstacle != self.obstacle:
            self.say(f"{obstacle}; {self._meanwhile()}")
        self.obstacle = obstacle
        return self.source

    def _opened(self) -> str:
        """Open the stream; return the reason if that fails, else ""."""
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
        """Close a stream that was removed or recreated; return what happened in words, "" for nothing."""
        same = self.source.same() if self.source is not None else True
        if same:
            return ""
        self.close()
        return "was removed" if same is None else "was recreated"

    def close(self) -> None:
        """Close the stream."""
        if self.source is not None:
            self.source.close()
            self.source = None
