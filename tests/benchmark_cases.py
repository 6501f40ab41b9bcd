"""Made-up results of benchmarks: nothing is timed."""

from __future__ import annotations

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
    rows = [
        Row(
            f"{n} of {side} x {side}",
            {
                "sub-apertures": float(n),
                "1 core: us per frame": 0.01 * n * side**2,
                "2 cores: us per frame": 0.006 * n * side**2,
            },
        )
        for side in (8, 16)
        for n in (36, 1208, 4616)
    ]
    return Table("scale", "Scale", rows)


def latency_table() -> Table:
    row = Row("36, 1 thread", {"p50": 110.0, "p99.9/p50": 36.4}, spread={"p99.9/p50": 0.2}, better="lower")
    return Table("latency", "Latency", [row])


def roofline_table() -> Table:
    row = Row("W = 16", {"bound ns": 4.0, "sweep ns": 5.0, "fraction": 0.8}, ">= 0.75", True)
    return Table("roofline", "Roofline", [row])


def results(
    tables: Sequence[Table] = (), *, started: str = "2026-01-02T03:04:05", machine: dict[str, str] = MACHINE
) -> Results:
    chosen = tables or [rivals_table(), scale_table(), latency_table(), roofline_table()]
    found = [Benchmark(table.name, 1.5, "0.1, 0.2, 0.3", [table]) for table in chosen]
    return Results(started, machine, {"numpy": "2.0"}, found)
