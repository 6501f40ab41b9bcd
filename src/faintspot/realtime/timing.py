"""Statistics of a running engine: a latency histogram of fixed size, and counters."""

from __future__ import annotations

import math
from array import array
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between

_BITS = 7  # 2^7 bins in every factor of 2: each is at most 1/128 of its value wide
_LONGEST_NS = 2**37 - 1  # 137 s; longer durations count in the last bin
_BINS = ((_LONGEST_NS.bit_length() - _BITS - 1) << _BITS) + 2 ** (_BITS + 1)
RESOLUTION = 2.0 ** -(_BITS + 1)
"""Largest relative error of a percentile."""


class Latencies:
    """Distribution of durations in a fixed amount of memory.

    A duration's bin is given by its leading 8 bits, so that finding it takes two shifts. Durations below 256
    ns are counted exactly, longer ones to within 0.4 %. Count, mean, smallest and largest are exact.

    One thread adds and resets; others may read at the same time.
    """

    __slots__ = ("_counts", "_largest", "_smallest", "_total")

    def __init__(self) -> None:
        self._counts = array("q", bytes(8 * _BINS))
        self.reset()

    def reset(self) -> None:
        """Clear the distribution."""
        self._counts[:] = array("q", bytes(8 * _BINS))
        self._total = 0
        self._smallest = -1
        self._largest = 0

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

    @property
    def count(self) -> int:
        """Number of durations."""
        return int(np.sum(self._snapshot()))

    @property
    def mean_ns(self) -> float:
        """Arithmetic mean [ns]; NaN without durations."""
        count = self.count
        return self._total / count if count else math.nan

    @property
    def smallest_ns(self) -> int:
        """Shortest duration [ns]; 0 without durations."""
        return max(self._smallest, 0)

    @property
    def largest_ns(self) -> int:
        """Longest duration [ns]; 0 without durations."""
        return self._largest

    def percentile_ns(self, percent: float) -> float:
        """Return the shortest duration that at least `percent` % of all do not exceed [ns].

        Within a factor 1 +- `RESOLUTION` of the exact value; NaN without durations.

        Raises
        ------
        InputError
            For a percentage outside 0 to 100.
        """
        percent = number_between("percent", percent, 0, 100)
        return self._percentile(self._snapshot(), percent)

    def distribution(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the bins in use: shortest and longest duration [ns, inclusive] and count."""
        counts = self._snapshot()
        index = np.flatnonzero(counts)
        shift = np.maximum((index >> _BITS) - 1, 0)
        lowest = (index - (shift << _BITS)) << shift
        return lowest, lowest + (1 << shift) - 1, counts[index]

    def merge(self, other: Latencies) -> Latencies:
        """Return the sum of both distributions."""
        both = Latencies()
        both._counts = array("q", (self._snapshot() + other._snapshot()).tobytes())
        both._total = self._total + other._total
        both._largest = max(self._largest, other._largest)
        seen = [part._smallest for part in (self, other) if part._smallest >= 0]
        both._smallest = min(seen, default=-1)
        return both

    def as_dict(self) -> dict[str, int | float | None]:
        """Return the count, and mean, percentiles, smallest and largest [us]; None without durations."""
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
        """Return a copy of the counts, so that the figures of one reading are consistent."""
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
    """Frames that were overwritten while being measured; also counted as dropped."""
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

    def as_dict(self) -> dict[str, Any]:
        """Return the counters by name."""
        return asdict(self)
