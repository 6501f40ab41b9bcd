"""Statistics of a running engine: latencies, counters, and why a frame was late or lost."""

import math
import resource
from array import array
from collections import Counter
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.engine.frames.frame_path import FramePath
from faintspot.io.telemetry import left_out

_BITS = 7  # 2^7 bins in every factor of 2: each is at most 1/128 of its value wide
_LONGEST_NS = 2**37 - 1  # 137 s; longer durations count in the last bin
_BINS = ((_LONGEST_NS.bit_length() - _BITS - 1) << _BITS) + 2 ** (_BITS + 1)


class Latencies:
    """Distribution of durations in a fixed amount of memory.

    A duration's bin is given by its leading 8 bits, so that finding it takes two shifts. Durations below 256
    ns are counted exactly, longer ones to within 0.4 %. Count, mean, smallest and largest are exact.

    One thread adds; others may read at the same time.
    """

    __slots__ = ("_counts", "_largest", "_smallest", "_total")

    def __init__(self) -> None:
        self._counts = array("q", bytes(8 * _BINS))
        self._total = self._largest = 0
        self._smallest = -1

    def add(self, duration_ns: int) -> None:
        """Count a duration [ns], a plain int; a negative one counts as 0."""
        if duration_ns < 0:
            duration_ns = 0
        if duration_ns > self._largest:
            self._largest = duration_ns
        if duration_ns < self._smallest or self._smallest < 0:
            self._smallest = duration_ns
        self._total += duration_ns
        if duration_ns > _LONGEST_NS:
            duration_ns = _LONGEST_NS
        shift = duration_ns.bit_length() - 8
        if shift < 0:
            shift = 0
        self._counts[(shift << 7) + (duration_ns >> shift)] += 1

    def as_dict(self) -> dict[str, int | float | None]:
        """Return the count, and mean, percentiles, smallest and largest [us]; None without durations.

        A percentile is the shortest duration that at least that part of all do not exceed, within a factor
        1 +- 1/256 of the exact value.
        """
        counts = np.cumsum(np.array(self._counts, np.int64))  # a copy: all figures are of one moment
        count = int(counts[-1])
        names = ("mean_us", "min_us", "p50_us", "p99_us", "p99_9_us", "max_us")
        if count == 0:
            return {"count": 0, **dict.fromkeys(names)}
        percentiles = (self._percentile(counts, percent) for percent in (50.0, 99.0, 99.9))
        values = (self._total / count, self._smallest, *percentiles, self._largest)
        return {"count": count, **{name: value / 1e3 for name, value in zip(names, values, strict=True)}}

    def _percentile(self, counts: NDArray[np.int64], percent: float) -> float:
        """Return a percentile [ns] of cumulative counts."""
        count = int(counts[-1])
        rank = max(math.ceil(percent / 100 * count - 1e-9 * count), 1)  # 0.999 of 1000 is the 999th
        index = int(np.searchsorted(counts, rank))
        if index == _BINS - 1:
            return float(self._largest)
        shift = max((index >> _BITS) - 1, 0)
        lowest = (index - (shift << _BITS)) << shift
        return float(min(max(lowest + ((1 << shift) - 1) / 2, self._smallest), self._largest))


@dataclass(slots=True)
class Counters:
    """Counters of an engine since its start, changed in place."""

    frames_in: int = 0
    """Frames that began to arrive."""
    processed: int = 0
    """Frames whose slopes were published."""
    dropped: int = 0
    """Frames that arrived but whose slopes were not published."""
    late: int = 0
    """Frames whose slopes were published later than allowed."""
    repeated: int = 0
    """Frames whose number was not above that of the frame before."""
    skipped: int = 0
    """Frame numbers that the source left out."""
    short: int = 0
    """Frames that ended before their last row; also counted as dropped."""
    torn: int = 0
    """Frames that were overwritten before they were measured; also counted as dropped."""
    passed_over: int = 0
    """Frames that were left out after such a frame, to go on with the newest; also counted as dropped."""
    invalid_subapertures: int = 0
    """Invalid slopes."""
    at_iteration_limit: int = 0
    """Slopes whose denoising ended at the iteration limit."""
    iterations: int = 0
    """Total number of denoising iterations of all sub-apertures."""
    settings_changes: int = 0
    """Changes of settings that took effect."""
    settings_refused: int = 0
    """Changes that were refused."""
    source_restarts: int = 0
    """Number of times that the source restarted or its frame numbers jumped too far ahead."""
    commands_renewed: int = 0
    """Number of times that NAME_commands was removed and recreated."""
    estimator_failures: int = 0
    """Frames in which an estimator in NumPy failed: all their slopes are invalid."""
    worker_restarts: int = 0
    """Worker threads that died and were replaced."""


IN_TIME, PREPARING, PAGE_FAULT, PREEMPTED, BLOCKED, WOKEN_LATE, OTHER, INCOMPLETE, WORKER = range(9)
CAUSES = (
    "in time",
    "settings prepared",
    "page fault",
    "preempted",
    "blocked",
    "woken late",
    "other",
    "incomplete",
    "worker died",
)
"""Causes in words, by their numbers. The first one that applies is named.

Settings were being prepared in the same process; a page of memory was missing; the scheduler gave the
processor to another program; another thread of the process held Python's interpreter lock; the thread woke
up after the rows were there. "other" includes long computations, worker threads that were preempted, and a
hypervisor that took the processor away. Lost frames only: the camera began the next frame before its last
row, or a worker died."""


class Lateness:
    """Counters of the calling thread, read once per frame; a microsecond each time."""

    def __init__(self) -> None:
        self._before = 0, 0, 0, 0

    def cause(self, late: bool, preparing: bool, woken_late: int, sleeps: int) -> int:
        """Return the number of the cause in `CAUSES` for a frame that was just published or lost.

        Parameters
        ----------
        late : bool
            Whether it was late or lost; the cause is 0 if not.
        preparing : bool
            Whether settings were being prepared.
        woken_late : int
            How often the thread has woken up after the rows were there.
        sleeps : int
            How often the thread has slept; other waits of the thread are for locks.
        """
        usage = resource.getrusage(resource.RUSAGE_THREAD)
        faults, waits = usage.ru_minflt + usage.ru_majflt, usage.ru_nvcsw - sleeps
        now = faults, usage.ru_nivcsw, waits, woken_late
        grown = [after > before for after, before in zip(now, self._before, strict=True)]
        self._before = now
        return PREPARING + (preparing, *grown, True).index(True) if late else IN_TIME


class FrameAccount:
    """Counters and latencies of an engine's frames, and why frames were late or lost.

    Parameters
    ----------
    deadline_s : float
        Latency beyond which slopes count as late.
    """

    def __init__(self, deadline_s: float) -> None:
        self.counters, self.latencies = Counters(), Latencies()
        self.late_because = Counter[str]()
        """Number of late frames by cause; see `CAUSES`."""
        self.lost_because = Counter[str]()
        """Number of lost frames by cause."""
        self._deadline_ns, self._lateness = round(deadline_s * 1e9), Lateness()
        self._lost = 0, IN_TIME  # since the last published frame: their number, and the last one's cause

    def published(self, latency_ns: int, path: FramePath, *, preparing: bool) -> tuple[int, int, int]:
        """Take the latency of a frame; return its cause, and number and last cause of frames lost before."""
        late, counters = latency_ns > self._deadline_ns, self.counters
        self.latencies.add(latency_ns)
        cause = self._lateness.cause(late, preparing, path.woken_late, path.sleeps)
        counters.estimator_failures += path.failed
        counters.late += late
        if late:
            self.late_because[CAUSES[cause]] += 1
        causes = cause, *self._lost
        self._lost = 0, IN_TIME
        return causes

    def finished(self, details: tuple[int, int, int], number: int, before: int | None) -> None:
        """Count a frame of which everything has been published.

        Parameters
        ----------
        details : (int, int, int)
            Invalid slopes, slopes at the iteration limit, iterations.
        number : int
        before : int, optional
            Number of the frame before; None for the first one.
        """
        counters = self.counters
        counters.frames_in += 1
        counters.processed += 1
        invalid, limited, iterations = details
        counters.invalid_subapertures += invalid
        counters.at_iteration_limit += limited
        counters.iterations += iterations
        if before is not None and number != before + 1:
            skipped = left_out(before, number)
            counters.skipped += max(skipped, 0)
            counters.repeated += number <= before
            counters.source_restarts += skipped < 0 and number > before

    def lost(self, frames: int, path: FramePath, *, preparing: bool, cause: int | None = None) -> None:
        """Count lost frames; the cause is found out if it is not given."""
        found = self._lateness.cause(True, preparing, path.woken_late, path.sleeps)
        cause = found if cause is None else cause
        self.counters.frames_in += frames
        self.counters.dropped += frames
        self.lost_because[CAUSES[cause]] += frames
        self._lost = self._lost[0] + frames, cause

    def as_dict(self) -> dict[str, object]:
        """Return everything as plain values."""
        return {
            "counters": asdict(self.counters),
            "late_because": dict(self.late_because),
            "lost_because": dict(self.lost_because),
            "latency": self.latencies.as_dict(),
        }
