"""Plants one fault after the other and says which tests find it: `python -m tests.fuzz.planted [NAME ...]`.

The faults, of planted.toml, are of the kind that a tired maintainer makes. Run it after tests were taken
away. A copy of the sources in build/planted, with its compiled kernels, gets each fault in turn.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

from tests.shared_data import ROOT

SOURCES = ROOT / "src" / "faintspot"
_COPY = ROOT / "build" / "planted"
_LIMIT_S = {"fast": 300, "slow": 900}
_OUTCOMES = {0: "missed", 1: "found", 2: "found", 5: "no tests"}  # by pytest's exit status


class Fault(NamedTuple):
    """A text of a source file, the text in its place, and the tests that ought to find it."""

    name: str
    file: str
    old: str
    new: str
    tests: list[str]

    @property
    def compiled(self) -> bool:
        """Whether all kernels are compiled anew."""
        return self.file.startswith("slopes/kernels/")


def faults() -> list[Fault]:
    """Return all faults, in the order of the layers."""
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return [
        Fault(name, row["file"], old=row["change"][0], new=row["change"][1], tests=row["tests"])
        for name, row in table.items()
    ]


def main() -> int:
    """Plant the faults that are named, or all; return 1 where one is missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.planted", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all faults")
    parser.add_argument("--slow", action="store_true", help="slow tests, too, where fast ones find nothing")
    parser.add_argument("--sound", action="store_true", help="plant nothing: all tests must pass")
    chosen = parser.parse_args()
    known = {fault.name: fault for fault in faults()}
    if unknown := set(chosen.names) - set(known):
        parser.error(f"no such fault: {', '.join(sorted(unknown))}")
    shutil.copytree(SOURCES, _COPY / "faintspot", dirs_exist_ok=True)  # with the times of files
    counts: dict[str, int] = {}
    for name in chosen.names or known:
        outcome = _outcome(known[name], plant=not chosen.sound, slow=chosen.slow)
        counts[outcome] = counts.get(outcome, 0) + 1
    print(", ".join(f"{outcome}: {count}" for outcome, count in counts.items()))
    return int("missed" in counts)


def _outcome(fault: Fault, *, plant: bool, slow: bool) -> str:
    """Plant a fault, print a line, and return what came of it."""
    target, begin = _COPY / "faintspot" / fault.file, time.monotonic()
    if plant:
        target.write_text(target.read_text(encoding="utf-8").replace(fault.old, fault.new), encoding="utf-8")
    try:
        seen = []
        for kind in ("fast", "slow") if slow else ("fast",):
            outcome, by = _tested(fault, kind)
            seen.append(outcome)
            if outcome == "found":
                seen = [f"found by {kind} tests"]
                break
        # Where one kind has no tests, the other one tells.
        outcome = next((each for each in ("not decided", "missed") if each in seen), seen[0])
    finally:
        shutil.copy2(SOURCES / fault.file, target)
    print(f"{fault.name:40} {outcome:20} {time.monotonic() - begin:4.0f} s  {by}", flush=True)
    return outcome


def _tested(fault: Fault, kind: str) -> tuple[str, str]:
    """Return what tests of a kind say, and the first that fails."""
    with tempfile.TemporaryDirectory() as kernels:
        environment = {**os.environ, "PYTHONPATH": str(_COPY)}
        if fault.compiled:
            environment["NUMBA_CACHE_DIR"] = kernels
        tests = [f"tests/{test}" for test in fault.tests]
        selected = "slow" if kind == "slow" else "not slow"
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", selected, *tests]
        try:
            done = subprocess.run(
                command,
                cwd=ROOT,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
                timeout=_LIMIT_S[kind],
            )
        except subprocess.TimeoutExpired:
            return "not decided", ""
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return _OUTCOMES.get(done.returncode, "not decided"), " ".join(failed[:1])[:120]


if __name__ == "__main__":
    sys.exit(main())
