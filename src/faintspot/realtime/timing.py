"""What a running engine counts: latencies as a histogram of fixed size, and events."""

from __future__ import annotations

import math
from array import array
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between

_BITS = 7  # 2^7 bins in every factor of 2: each is at most 1/128 of its value wide
_LONGEST_NS = 2**37 - 1  # 137 s; what is longer counts in the last bin
_BINS = ((_LONGEST_NS.bit_length() - _BITS - 1) << _BITS) + 2 ** (_BITS + 1)
RESOLUTION = 2.0 ** -(_BITS + 1)
"""Largest relative error of a percentile."""


class Latencies:
    """Distribution of durations, in memory that does not grow.

    A duration's bin is its leading 8 bits, so that finding it takes two shifts; durations below 256 ns
    are counted exactly, longer ones to within 0.4 %. Count, mean, smallest and largest are exact.

    One thread adds and resets; others may read at the same time.
    """

    __slots__ = ("_counts", "_largest", "_smallest", "_total")

    def __init__(self) -> None:
        self._counts = array("q", bytes(8 * _BINS))
        self.reset()

    def reset(self) -> None:
        """Forget everything; the memory stays."""
        self._counts[:] = array("q", bytes(8 * _BINS))
        self._total = 0
        self._smallest = -1
        self._largest = 0

    def add(self, duration_ns: int) -> None:
        """Count a duration, ns, a plain int; a negative one counts as 0."""
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

    @property
    def count(self) -> int:
        """Number of durations."""
        return int(np.sum(self._snapshot()))

    @property
    def mean_ns(self) -> float:
        """Arithmetic mean, ns; NaN when there is nothing."""
        count = self.count
        return self._total / count if count else math.nan

    @property
    def smallest_ns(self) -> int:
        """Shortest duration, ns; 0 when there is nothing."""
        return max(self._smallest, 0)

    @property
    def largest_ns(self) -> int:
        """Longest duration, ns; 0 when there is nothing."""
        return self._largest

    def percentile_ns(self, percent: float) -> float:
        """Return the shortest duration that at least `percent` % of all do not exceed, ns.

        Within a factor 1 +- `RESOLUTION` of the exact value; NaN when there is nothing.

        Raises
        ------
        InputError
            For a percentage outside 0 to 100.
        """
        percent = number_between("percent", percent, 0, 100)
        return self._percentile(self._snapshot(), percent)

    def distribution(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the bins that hold something: shortest and longest duration (ns, inclusive) and count."""
        counts = self._snapshot()
        index = np.flatnonzero(counts)
        shift = np.maximum((index >> _BITS) - 1, 0)
        lowest = (index - (shift << _BITS)) << shift
        return lowest, lowest + (1 << shift) - 1, counts[index]

    def merge(self, other: Latencies) -> Latencies:
        """Return the distribution of both together."""
        both = Latencies()
        both._counts = array("q", (self._snapshot() + other._snapshot()).tobytes())
        both._total = self._total + other._total
        both._largest = max(self._largest, other._largest)
        seen = [part._smallest for part in (self, other) if part._smallest >= 0]
        both._smallest = min(seen, default=-1)
        return both

    def as_dict(self) -> dict[str, int | float | None]:
        """Return count, and mean, percentiles, smallest and largest in microseconds; None without any."""
        counts = self._snapshot()
        count = int(counts.sum())
        values = {
            "mean_us": self._total / count if count else math.nan,
            "min_us": self.smallest_ns,
            "p50_us": self._percentile(counts, 50.0),
            "p99_us": self._percentile(counts, 99.0),
            "p99_9_us": self._percentile(counts, 99.9),
            "max_us": self.largest_ns,
        }
        return {"count": count, **{name: value / 1e3 if count else None for name, value in values.items()}}

    def _snapshot(self) -> NDArray[np.int64]:
        """A copy of the counts, made in one step, so that one reading's figures fit together."""
        return np.array(self._counts, np.int64)

    def _percentile(self, counts: NDArray[np.int64], percent: float) -> float:
        cumulative = np.cumsum(counts)
        count = int(cumulative[-1])
        if count == 0:
            return math.nan
        rank = max(math.ceil(percent / 100 * count - 1e-9 * count), 1)  # 0.999 of 1000 is the 999th
        index = int(np.searchsorted(cumulative, rank))
        shift = max((index >> _BITS) - 1, 0)
        lowest = (index - (shift << _BITS)) << shift
        if index == _BINS - 1:
            return float(self._largest)
        middle = lowest + ((1 << shift) - 1) / 2
        return float(min(max(middle, self.smallest_ns), self._largest))


@dataclass(slots=True)
class Counters:
    """What an engine has seen and done since it started; plain numbers, changed in place."""

    frames_in: int = 0
    """Frames that began to arrive."""
    processed: int = 0
    """Frames whose slopes were published."""
    dropped: int = 0
    """Frames that arrived and whose slopes were not published."""
    late: int = 0
    """Frames whose slopes were published after the time allowed."""
    repeated: int = 0
    """Frames whose number was that of the frame before, or lower."""
    skipped: int = 0
    """Frame numbers that the source left out."""
    short: int = 0
    """Frames that ended before their last row; they count as dropped too."""
    torn: int = 0
    """Frames that were overwritten while they were measured; they count as dropped too."""
    invalid_subapertures: int = 0
    """Slopes that were not valid."""
    at_iteration_limit: int = 0
    """Slopes whose denoising ended at the iteration limit."""
    iterations: int = 0
    """Iterations of the denoising, of all sub-apertures together."""
    settings_changes: int = 0
    """Changes of settings that took effect."""
    settings_refused: int = 0
    """Changes that were refused."""
    source_restarts: int = 0
    """How often the source went away and came back, or its frame numbers jumped too far ahead."""
    commands_renewed: int = 0
    """How often NAME_commands was removed and made anew."""
    estimator_failures: int = 0
    """Frames in which an estimator in NumPy failed: all their slopes are invalid."""
    worker_restarts: int = 0
    """Worker threads that died and were replaced."""

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers by name."""
        return asdict(self)
