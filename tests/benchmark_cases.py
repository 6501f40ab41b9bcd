"""Made-up results of benchmarks: nothing is timed."""

from collections.abc import Sequence

from benchmarks.measuring import Row, Table
from benchmarks.results import Benchmark, Results

MACHINE = {"processor": "one", "processors": "2 of 2", "kernel": "Linux 1"}


def rivals_table(ratio: float = 20.0, spread: float = 0.01) -> Table:
    row = Row(
        "36: NumPy, all at once",
        {"faintspot us": 2.0, "rival us": 2.0 * ratio, "ratio of best": ratio, "median ratio": ratio},
        ">= 9",
        ratio >= 9,
        {"ratio of best": spread, "median ratio": spread},
    )
    other = Row("36: OpenCV", {"median ratio": 18.0}, spread={"median ratio": spread}, better="higher")
    return Table("rivals", "Against <others>", [row, other], ["a note & more"])


def scale_table() -> Table:
    rows = [Row(f"{n} of 8 x 8", {"1 core: us per frame": 0.6 * n}) for n in (36, 1208, 4616)]
    return Table("scale", "Scale", rows)


def results(
    tables: Sequence[Table] = (), *, started: str = "2026-01-02T03:04:05", machine: dict[str, str] = MACHINE
) -> Results:
    chosen = tables or [rivals_table(), scale_table()]
    found = [Benchmark(table.name, 1.5, "0.1, 0.2, 0.3", [table]) for table in chosen]
    return Results(started, machine, {"numpy": "2.0"}, found)
