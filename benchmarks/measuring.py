"""How the benchmarks measure, and how they show what they found.

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
"""

from __future__ import annotations

import gc
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Candidate = Callable[[], Any]
Times = dict[str, NDArray[np.float64]]

_SHORTEST_SAMPLE_S = 0.005  # far above the clock's resolution, short enough to fall between disturbances
_PACKAGES = ("faintspot", "numpy", "numba", "llvmlite", "jax", "pyrtcao", "scikit-image")


@dataclass(frozen=True)
class Row:
    """One line of a table: numbers by column, and a target with whether it is met."""

    name: str
    values: dict[str, float]
    target: str = ""
    met: bool | None = None


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


def interleaved(candidates: dict[str, Candidate], *, seconds: float = 3.0, fewest: int = 5) -> Times:
    """Time candidates in turn until `seconds` have passed, but at least `fewest` turns.

    Returns
    -------
    dict
        Seconds per call of every turn, by candidate.
    """
    calls = {}
    for name, candidate in candidates.items():
        candidate()  # compile, fill caches
        calls[name] = max(1, round(_SHORTEST_SAMPLE_S / max(_seconds(candidate, 1), 1e-9)))
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


def machine() -> dict[str, str]:
    """Describe the machine and the versions of what runs on it."""
    from faintspot.kernels.host import lanes_for

    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
        processor = names[0].split(":", 1)[1].strip() if names else processor
    facts = {
        "processor": processor,
        "processors": str(os.cpu_count()),
        "SIMD lanes (float32)": str(lanes_for(np.float32).width),
        "load average": ", ".join(f"{load:.1f}" for load in os.getloadavg()),
        "python": platform.python_version(),
    }
    for package in _PACKAGES:
        try:
            facts[package] = version(package)
        except PackageNotFoundError:
            facts[package] = "not installed"
    return facts


def _text(value: float) -> str:
    """Return three significant digits."""
    if 0 < abs(value) < 1e-3:
        return f"{value:.0e}"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"{value:.{digits}f}"


def show(table: Table) -> None:
    """Print a table."""
    import rich.table
    from rich.console import Console

    columns = list(dict.fromkeys(column for row in table.rows for column in row.values))
    console = Console(width=max(130, Console().width))
    grid = rich.table.Table(title=table.title, title_justify="left")
    with_targets = any(row.target for row in table.rows)
    grid.add_column("", no_wrap=True)
    for column in columns:
        grid.add_column(column, justify="right")
    for heading in ("target", "met") if with_targets else ():
        grid.add_column(heading)
    for row in table.rows:
        cells = [row.name] + [_text(row.values[c]) if c in row.values else "" for c in columns]
        if with_targets:
            cells += [row.target, "" if row.met is None else "yes" if row.met else "NO"]
        grid.add_row(*cells)
    console.print(grid)
    for note in table.notes:
        console.print(f"  {note}", highlight=False, markup=False)
    console.print()


def as_json(tables: list[Table], facts: dict[str, str]) -> dict[str, Any]:
    """Return everything as plain values."""
    return {"machine": facts, "benchmarks": [asdict(table) for table in tables]}
