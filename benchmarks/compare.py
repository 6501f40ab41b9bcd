"""What changed between two runs, beyond noise: `python -m benchmarks compare [OLD NEW]`.

Compared are the figures that come with a spread: ratios, measured side by side in one run, and a few
absolute times. A change is that of a figure from one run to the next, in per cent. Its noise is three
standard errors of both runs together, each that within the run (its spread) and 2 %, because a new process
finds its memory in another place, which no spread within a run shows. What changed by more is better or
worse; the rest is within noise. Of a row with several figures, all must have changed so, and in the same
direction: on a busy machine the ratio of best or the median ratio is easily off by a factor of two, but
hardly both, while a change of the code moves both.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.measuring import Row
from benchmarks.results import Results, ResultsError, newest_first, read

BETTER, WORSE, WITHIN_NOISE = "better", "worse", "within noise"
_BETWEEN = " | "
_PLACE = 0.02
_ERRORS = 3.0


@dataclass(frozen=True)
class Figure:
    """One number of a run; `sign` is 1 where higher is better, else -1."""

    value: float
    spread: float
    sign: int


@dataclass(frozen=True)
class Change:
    """One number of both runs; change and noise as natural logarithms."""

    name: str
    old: float
    new: float
    change: float
    noise: float
    verdict: str


def figures(results: Results) -> dict[str, Figure]:
    """Return the figures of a run that can be compared, by name."""
    found = {}
    for benchmark in results.benchmarks:
        for table in benchmark.tables:
            for row in table.rows:
                for column, spread in row.spread.items():
                    value, sign = row.values[column], _sign(row)
                    if sign and math.isfinite(value) and value > 0 and math.isfinite(spread):
                        name = _BETWEEN.join((table.name, row.name, column))
                        found[name] = Figure(value, spread, sign)
    return found


def changes(old: Results, new: Results) -> Iterator[Change]:
    """Yield the changes of what both runs have."""
    before, after = figures(old), figures(new)
    rows: dict[str, list[Change]] = {}
    for name in after:
        if name in before:
            row = name.rpartition(_BETWEEN)[0]
            rows.setdefault(row, []).append(_change(name, before[name], after[name]))
    for found in rows.values():
        agree = len({change.verdict for change in found}) == 1
        yield from found if agree else (replace(change, verdict=WITHIN_NOISE) for change in found)


def _change(name: str, old: Figure, new: Figure) -> Change:
    change = math.log(new.value / old.value)
    noise = _ERRORS * math.hypot(old.spread, _PLACE, new.spread, _PLACE)
    verdict = WITHIN_NOISE
    if abs(change) > noise:
        verdict = BETTER if change * new.sign > 0 else WORSE
    return Change(name, old.value, new.value, change, noise, verdict)


def _sign(row: Row) -> int:
    """Return whether higher is better (1) or lower (-1), 0 when nobody says."""
    known = {"higher": 1, "lower": -1}
    if row.better:
        return known[row.better]
    if ">" in row.target or "at least" in row.target:
        return 1
    return -1 if "<" in row.target else 0


def same_machine(old: Results, new: Results) -> str:
    """Return what differs between the machines of two runs, in a line; "" when nothing does."""
    names = list(dict.fromkeys([*old.fingerprint, *new.fingerprint]))
    differing = [
        f"{name}: {old.fingerprint.get(name, 'unknown')} and {new.fingerprint.get(name, 'unknown')}"
        for name in names
        if old.fingerprint.get(name) != new.fingerprint.get(name)
    ]
    return "; ".join(differing)


def two_newest(folder: Path, *, anyway: bool = False) -> tuple[Path, Path]:
    """Return the newest results of a folder, and before it the newest before of the same machine.

    Raises
    ------
    ResultsError
        When there are none.
    """
    paths = newest_first(folder)
    if len(paths) < 2:
        raise ResultsError(f"{folder}: expected two results to compare, got {len(paths)}")
    newest = read(paths[0])
    for path in paths[1:]:
        if anyway or not same_machine(read(path), newest):
            return path, paths[0]
    raise ResultsError(f"{paths[0].name}: no earlier results of the same machine (--anyway: of any)")


def compare(old_path: Path, new_path: Path, *, anyway: bool = False) -> tuple[list[Change], list[str]]:
    """Return the changes between two files, and what else must be said.

    Raises
    ------
    ResultsError
        When the machines differ, unless `anyway`, or nothing is in both.
    """
    old, new = read(old_path), read(new_path)
    differing = same_machine(old, new)
    if differing and not anyway:
        raise ResultsError(f"different machines (--anyway compares them): {differing}")
    found = list(changes(old, new))
    if not found:
        raise ResultsError(f"{old_path.name}, {new_path.name}: no figure is in both")
    notes = [f"{old_path.name} -> {new_path.name}"]
    if differing:
        notes.append(f"different machines: {differing}")
    only = [len(figures(one).keys() - figures(other).keys()) for one, other in ((old, new), (new, old))]
    if any(only):
        notes.append(f"not compared: {only[0]} figures of the old run alone, {only[1]} of the new one alone")
    versions = [
        f"{name} {old.versions.get(name, 'unknown')} -> {version}"
        for name, version in new.versions.items()
        if old.versions.get(name) != version
    ]
    return found, notes + (["other versions: " + ", ".join(versions)] if versions else [])


def show(found: list[Change], notes: list[str]) -> None:
    """Print the changes, what got worse first."""
    import rich.table
    from rich.console import Console

    from benchmarks.showing import number

    order = (WORSE, BETTER, WITHIN_NOISE)
    console = Console(width=max(130, Console().width))
    table = rich.table.Table(title="What changed", title_justify="left")
    for heading in ("figure", "old", "new", "change", "noise", "verdict"):
        table.add_column(heading, justify="right" if heading in ("old", "new", "change", "noise") else "left")
    for change in sorted(found, key=lambda each: (order.index(each.verdict), -abs(each.change))):
        moved, noise = math.expm1(change.change), math.expm1(change.noise)
        table.add_row(
            change.name,
            number(change.old),
            number(change.new),
            f"{moved:+.1%}",
            f"±{noise:.1%}",
            change.verdict,
        )
    console.print(table)
    counts = [f"{sum(each.verdict == verdict for each in found)} {verdict}" for verdict in order]
    for line in [", ".join(counts), *notes]:
        console.print(f"  {line}", highlight=False, markup=False)
