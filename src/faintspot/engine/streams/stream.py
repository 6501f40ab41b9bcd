"""Streams that other programs publish: pyshmem's NAME and ImageStreamIO's isio:NAME."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.engine.streams.image_layout import ISIO, IncompatibleStreamError, path_of
from faintspot.engine.streams.image_stream import LARGEST_NUMBER, ImageStream, Publication
from faintspot.engine.streams.shared_streams import lock_file, pyshmem_module
from faintspot.io.telemetry import left_out

_NAP_S = 5e-4
_READ_S = 1e-3  # to wait for a writer in the middle of a publication


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

    def read(self, out: NDArray[np.generic] | None = None, limit_s: float = 0.0) -> Publication | None:
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

    def read(self, out: NDArray[np.generic] | None = None, limit_s: float = 0.0) -> Publication | None:
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


def image_name(name: str) -> str | None:
    """Return NAME of isio:NAME; None for a stream of pyshmem."""
    kind, separator, rest = name.partition(":")
    return rest if separator and kind == ISIO else None


def check_stream(name: str) -> None:
    """Check that a stream can have that name, and that pyshmem is installed if it is needed.

    Raises
    ------
    InputError, MissingExtraError
        When it cannot, or pyshmem is missing.
    """
    image = image_name(name)
    if image is not None:
        path_of(image)
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
    image = image_name(name)
    if image is not None:
        try:
            return ImageStream(image)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise IncompatibleStreamError(f"cannot be opened ({error.strerror})") from None
    return PyshmemStream(name)


@dataclass(slots=True)
class StreamCounters:
    """Counters of what was read of a stream, changed in place."""

    taken: int = 0
    """Publications that were used."""
    missed: int = 0
    """Publications that were overwritten before they were read."""
    incomplete: int = 0
    """Publications whose writer died or paused before they were complete."""
    restarts: int = 0
    """Number of times that the stream was removed or recreated, or its count jumped."""


class Follower:
    """Connection to a named stream, which may be missing, unusable, removed or recreated.

    Parameters
    ----------
    stream : str
        Name of the stream.
    say : function, optional
        Called with a one-line message when the stream changes.
    incompatible : function, optional
        Takes shape and type; returns what was expected instead, "" if they fit. Default: everything fits.

    Attributes
    ----------
    counters : StreamCounters
        What `look` and `take` found.
    source : Stream or None
    obstacle : str
        Why there is no stream; "" if there is one.
    seen : int
        Number of publications of the stream up to the last one that `take` returned.
    using : threading.Lock
        Held by a thread that reads `source` while another one may call `look` or `close`: a stream that is
        closed is unmapped at once. Those who hold it take `source` anew.
    """

    holds = "values"
    """Contents of the stream, for messages."""

    def __init__(
        self,
        stream: str,
        say: Callable[[str], None] | None = None,
        incompatible: Callable[[tuple[int, ...], np.dtype[np.generic]], str] = lambda shape, dtype: "",
    ) -> None:
        check_stream(stream)
        self.stream, self._say, self._incompatible = stream, say or (lambda text: None), incompatible
        self.source: Stream | None = None
        self.using = threading.Lock()
        self.obstacle = "is not there"
        self.counters = StreamCounters()
        self.seen, self._reported, self._next_look_s = 0, "", -math.inf

    def say(self, text: str) -> None:
        """Report a change of the stream."""
        self._say(f"stream {self.stream}: {text}")

    @property
    def meanwhile(self) -> str:
        """Activity without a stream, for messages."""
        return "waiting"

    def prepare(self, source: Stream) -> None:
        """Get ready for a newly opened stream, before its opening is reported."""

    def look(self, period_s: float = 0.0) -> Stream | None:
        """Close a stream that was removed or recreated, and open a missing one, at most once in `period_s`.

        Returns
        -------
        Stream or None
            The stream, if it was opened now.
        """
        now = time.monotonic()
        if now < self._next_look_s:
            return None
        self._next_look_s = now + period_s
        if self.source is not None:
            same = self.source.same()
            if same:
                return None
            self.counters.restarts += 1
            self._let_go()
            self.say("was removed" if same is None else "was recreated")
        self.obstacle = self._opened()
        if self.obstacle != self._reported and self.obstacle:
            self.say(f"{self.obstacle}; {self.meanwhile}")
        self._reported = self.obstacle
        source = self.source
        if source is not None:
            self.prepare(source)
            self.say(f"{' x '.join(map(str, source.shape))} {self.holds} ({source.dtype}), {source.maker}")
        return source

    def take(self, limit_s: float, out: NDArray[np.generic] | None = None) -> Publication | None:
        """Return the newest publication if it is new, and complete within `limit_s`; see `Stream.read`."""
        source, counters = self.source, self.counters
        if source is None or source.count == self.seen:
            return None
        publication = source.read(out, limit_s)
        if publication is None:
            counters.incomplete += 1
            return None
        missed = left_out(self.seen, publication.total)
        counters.missed += max(missed, 0)
        counters.restarts += missed < 0 and publication.total > self.seen
        self.seen = publication.total
        return publication

    def wait(self, limit_s: float) -> bool:
        """Wait up to `limit_s` for a new publication, else look for the stream; return whether one came."""
        if self.source is not None and self.source.wait(self.seen, limit_s):
            return True
        opened = self.look()
        if opened is not None:
            return opened.wait(self.seen, limit_s)
        if self.source is None:
            time.sleep(limit_s)
        return False

    def newest(self, period_s: float = 1.0) -> Publication | None:
        """Return what `take` gives; without, look for the stream at most once in `period_s`.

        So a stream that was removed is read as long as its writer goes on.
        """
        publication = self.take(_READ_S)
        if publication is None and self.look(period_s) is not None:
            return self.take(_READ_S)
        return publication

    def _opened(self) -> str:
        """Open the stream; return the reason if that fails, else ""."""
        try:
            source = open_stream(self.stream)
        except FileNotFoundError:
            return "is not there"
        except IncompatibleStreamError as error:
            return str(error)
        obstacle = self._incompatible(source.shape, source.dtype)
        if obstacle:
            source.close()
            return f"holds {source.shape} {source.dtype}, expected {obstacle}"
        self.source, self.seen = source, max(source.count - 1, 0)  # earlier ones were not missed
        return ""

    def close(self) -> None:
        """Close the stream."""
        self._let_go()

    def _let_go(self) -> None:
        source, self.source = self.source, None
        if source is not None:
            with self.using:
                source.close()
