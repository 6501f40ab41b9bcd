"""How the benchmarks measure.

Other programs share the machine, so absolute times are only indicative. What counts are ratios, and these
are measured side by side: all candidates take turns (A B A B ...), on one processor, within one process.
Of many turns two statistics are kept:

- the *best* time of each candidate, and the ratio of these. Interference only ever adds to the time of
  deterministic work, so the minimum is the least disturbed sample. It repeats from run to run within 2 %
  where data fit the first-level cache, and within 10 % where not (it depends on where memory happens to
  lie), while the median varied by 50 %: a neighbour, probably on the same physical core, slows loops
  that need many instructions in flight and leaves others as they are.
- the *median of the ratios of turns*: a slow phase hits both partners of a turn, but not always equally.

A target of a ratio is met when both meet it (roofline.py: the first, and it says why).

Each ratio comes with its spread: the turns are cut into ten successive parts, the ratio is taken without one
of them after the other, and by how much it moves tells its standard error (the jackknife, by blocks, because
slow phases last for many turns). compare.py needs it to tell a change from noise.
"""

import gc
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Candidate = Callable[[], Any]
Times = dict[str, NDArray[np.float64]]

_SHORTEST_SAMPLE_S = 0.005  # far above the clock's resolution, short enough to fall between disturbances
_PARTS = 10
_ABSOLUTE = 0.1
"""Absolute times depend on who else uses the machine, too: by how much, from run to run, roughly."""


@dataclass(frozen=True)
class Row:
    """One line of a table: numbers by column, and a target with whether it is met."""

    name: str
    values: dict[str, float]
    target: str = ""
    met: bool | None = None
    spread: dict[str, float] = field(default_factory=dict)
    """Relative standard error of those values that are compared from run to run."""
    better: str = ""
    """Whether "higher" or "lower" values of these are better; without it, the target says."""


@dataclass(frozen=True)
class Table:
    """What one benchmark found."""

    name: str
    title: str
    rows: list[Row]
    notes: list[str] = field(default_factory=list)


@contextmanager
def pinned() -> Iterator[None]:
    """Stay on one processor: threads started meanwhile inherit it, too."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _seconds(candidate: Candidate, calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        candidate()
    return (time.perf_counter() - start) / calls


def interleaved(
    candidates: dict[str, Candidate],
    *,
    seconds: float = 3.0,
    fewest: int = 5,
    sample_s: float = _SHORTEST_SAMPLE_S,
) -> Times:
    """Time candidates in turn until `seconds` have passed, but at least `fewest` turns of `sample_s` each.

    Returns
    -------
    dict
        Seconds per call of every turn, by candidate.
    """
    calls = {}
    for name, candidate in candidates.items():
        candidate()  # compile, fill caches
        calls[name] = max(1, round(sample_s / max(_seconds(candidate, 1), 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in candidates}
    collecting = gc.isenabled()
    gc.disable()
    start = time.perf_counter()
    while len(next(iter(times.values()))) < fewest or time.perf_counter() - start < seconds:
        for name, candidate in candidates.items():
            times[name].append(_seconds(candidate, calls[name]))
    if collecting:
        gc.enable()
    return {name: np.array(values) for name, values in times.items()}


def median_ratio(times: Times, numerator: str, denominator: str) -> float:
    """Return the median over the turns of the ratio of two candidates' times."""
    return float(np.median(times[numerator] / times[denominator]))


def best(times: Times, name: str) -> float:
    """Return the shortest time of a candidate, in seconds."""
    return float(times[name].min())


def spread(times: Times, statistic: Callable[[Times], float]) -> float:
    """Return the relative standard error of a statistic of the times, by a jackknife.

    It is infinite where noise makes the statistic, a difference of times perhaps, negative.
    """
    turns = len(next(iter(times.values())))
    if turns < 2:
        raise ValueError(f"times: expected at least two turns, got {turns}")
    parts = np.array_split(np.arange(turns), min(_PARTS, turns))
    found = [statistic({name: np.delete(each, part) for name, each in times.items()}) for part in parts]
    if min(found) <= 0:
        return math.inf
    return float(np.std(np.log(found)) * np.sqrt(len(parts) - 1))


def absolute_spread(times: Times, name: str) -> float:
    """Return the same for the shortest time of a candidate alone."""
    return float(np.hypot(spread(times, lambda part: best(part, name)), _ABSOLUTE))


@dataclass(frozen=True)
class Ratio:
    """Both ratios of two candidates' times, and the spread of each, under the names of their columns."""

    values: dict[str, float]
    spread: dict[str, float]

    @property
    def smaller(self) -> float:
        """The smaller one of both."""
        return min(self.values.values())

    @property
    def larger(self) -> float:
        """The larger one of both."""
        return max(self.values.values())


def ratio(
    times: Times,
    numerator: str,
    denominator: str,
    columns: tuple[str, str] = ("ratio of best", "median ratio"),
) -> Ratio:
    """Return the ratio of best and the median ratio of two candidates' times."""
    statistics: tuple[Callable[[Times], float], ...] = (
        lambda part: best(part, numerator) / best(part, denominator),
        lambda part: median_ratio(part, numerator, denominator),
    )
    named = dict(zip(columns, statistics, strict=True))
    return Ratio(
        {name: statistic(times) for name, statistic in named.items()},
        {name: spread(times, statistic) for name, statistic in named.items()},
    )
