"""Processor seconds of every test and of every kernel that tests compile: `make durations`.

Runs the tests twice, with empty and with full caches of kernels, and writes tests/durations.csv: a row for
each file of tests, each test above half a second and each kernel. Compare rows of one table, or of two tables
from the same machine in the same hour.
"""

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

_FOLDER = "FAINTSPOT_DURATIONS"
_TABLE = Path(__file__).with_suffix(".csv")
_SHOWN_S = 0.5

_compiling: list[float] = []


def _write(kind: str, name: str, seconds: float) -> None:
    with Path(os.environ[_FOLDER], f"{os.getpid()}.tsv").open("a") as file:
        file.write(f"{kind}\t{name}\t{seconds:.6f}\n")


def _seconds() -> float:
    """Return the processor time of this process and of the children that it has waited for [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def pytest_configure() -> None:
    """Note what each compilation costs."""
    from numba.core import event

    class Compilations(event.Listener):
        def on_start(self, _: Any) -> None:
            _compiling.append(time.process_time())

        def on_end(self, ended: Any) -> None:
            start = _compiling.pop()
            if not _compiling:  # not within the compilation of a kernel that calls this one
                function = ended.data["dispatcher"].py_func
                name = f"{function.__module__}.{function.__name__}"
                _write("kernel", name, time.process_time() - start)

    event.register("numba:compile", Compilations())


def pytest_collection_finish() -> None:
    """Note what a process needs before its first test."""
    _write("all", "collection", time.process_time())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Note what a test costs with its fixtures."""
    start = _seconds()
    try:
        return (yield)
    finally:
        _write("test", item.nodeid.partition("[")[0], _seconds() - start)


def _run(caches: Path, chosen: list[str]) -> tuple[dict[tuple[str, str], float], Counter[tuple[str, str]]]:
    """Return the seconds and the number of each kind and name of one run of the tests."""
    seconds, number = defaultdict[tuple[str, str], float](float), Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        surroundings = {**os.environ, _FOLDER: folder, "NUMBA_CACHE_DIR": str(caches)}
        surroundings.pop("PYTHONDONTWRITEBYTECODE", None)
        before = os.times()
        command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "worksteal", "-p", "tests.durations"]
        subprocess.run([*command, *chosen], env=surroundings, check=False)
        after = os.times()
        for file in Path(folder).iterdir():
            for line in file.read_text().splitlines():
                kind, name, value = line.split("\t")
                names = [(kind, name)]
                names += [("file", name.partition("::")[0]), ("all", "tests")] if kind == "test" else []
                names += [("all", "compilation")] if kind == "kernel" else []
                for key in names:
                    seconds[key] += float(value)
                    number[key] += 1
    seconds["all", "processes"] = (
        after.children_user - before.children_user + after.children_system - before.children_system
    )
    number["all", "processes"] = 1
    return seconds, number


def main() -> None:
    """Run the tests twice and write the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.durations", description=__doc__.partition("\n")[0])
    parser.add_argument("--output", type=Path, default=_TABLE, help="table to write")
    parser.add_argument("chosen", nargs="*", help="arguments of pytest [default: -m 'not slow']")
    options = parser.parse_args()
    chosen = options.chosen or ["-m", "not slow"]
    with tempfile.TemporaryDirectory() as caches:
        cold, number = _run(Path(caches), chosen)
        warm, _ = _run(Path(caches), chosen)
    rows = sorted(cold, key=lambda key: (("all", "kernel", "file", "test").index(key[0]), -cold[key]))
    with options.output.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["kind", "name", "number", "cold_s", "warm_s"])
        for kind, name in rows:
            if kind != "test" or cold[kind, name] >= _SHOWN_S:
                times = cold[kind, name], warm[kind, name]
                writer.writerow([kind, name, number[kind, name], *(f"{value:.2f}" for value in times)])


if __name__ == "__main__":
    main()
