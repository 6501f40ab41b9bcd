"""Throws hostile values at kernels, functions and files: `python -m tests.fuzz --minutes 60`.

Every part runs in a process of its own, whose memory is limited, so that a segmentation fault, a hang or a
huge allocation is a finding with a seed. `--part kernels --seed 123 --minutes 0` repeats one.
"""

import argparse
import faulthandler
import importlib
import os
import resource
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tests.shared_data import ROOT

PARTS = ("kernels", "files", "values", "properties")
# A case, with compiling; longer is a hang.
_SLOWEST_S = {"kernels": 300, "files": 60, "values": 120, "properties": 7200}
# Beyond what there is at the start.
_MEMORY_BYTES = {"kernels": 8 << 30, "files": 5 << 29, "values": 6 << 30, "properties": 8 << 30}


def main() -> int:
    """Run the parts one after the other, each for its share of the time; return 1 where one has findings."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Hostile values at every door.")
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="in all (default 60); 0: one case of each part"
    )
    parser.add_argument("--seed", type=int, help="of the first case; default: another each time")
    parser.add_argument("--part", choices=PARTS, action="append", help="only this one (may be repeated)")
    parser.add_argument("--widths", default="4,8,16", help="SIMD widths of kernels (default all)")
    parser.add_argument("--keep-going", action="store_true", help="also after a finding")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    parts = chosen.part or list(PARTS)
    first = int.from_bytes(os.urandom(4), "big") if chosen.seed is None else chosen.seed
    seconds = 60 * chosen.minutes / len(parts)
    if chosen.here:
        widths = tuple(int(width) for width in chosen.widths.split(","))
        return _run(_cases(parts[0], widths), parts[0], first, seconds, chosen.keep_going)
    failed = 0
    for part in parts:
        command = [sys.executable, "-m", "tests.fuzz", "--here", "--part", part, "--seed", str(first)]
        command += ["--minutes", str(seconds / 60), "--widths", chosen.widths]
        command += ["--keep-going"] if chosen.keep_going else []
        status = subprocess.run(command, cwd=ROOT, check=False).returncode
        failed += status != 0
        print(
            f"{part}: {f'FOUND something (exit status {status})' if status else 'nothing found'}", flush=True
        )
    return int(failed > 0)


def _cases(part: str, widths: tuple[int, ...]) -> Callable[[int], None]:
    """Return what runs the case of a seed."""
    if part == "kernels":
        from tests.fuzz import kernels

        return partial(kernels.run, chosen=kernels.combinations(widths))
    if part == "properties":
        return _try_properties
    return importlib.import_module(f"tests.fuzz.{part}").run  # type: ignore[no-any-return]


def _try_properties(seed: int) -> None:
    """Run every test that Hypothesis draws examples for, with others than in the tests."""
    options = ["-m", "hypothesis", "--hypothesis-profile", "random", "--hypothesis-seed", str(seed)]
    subprocess.run([sys.executable, "-m", "pytest", *options, "-p", "no:cacheprovider"], cwd=ROOT, check=True)


def _run(run: Callable[[int], None], part: str, first: int, seconds: float, keep_going: bool) -> int:
    """Run cases in this process until the time is over or one fails; its seed is what it says last."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + _MEMORY_BYTES[part]
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    faulthandler.enable()
    end, seed, status = time.monotonic() + seconds, first, 0
    while True:
        faulthandler.dump_traceback_later(_SLOWEST_S[part], exit=True)
        print(f"\r{part} --seed {seed} ", end="", flush=True)
        try:
            run(seed)
        except (Exception, SystemExit):  # code of others that ends the process must not end this one well
            print(f"\r{part} --seed {seed} FAILED:\n{traceback.format_exc()}", flush=True)
            status = 1
        faulthandler.cancel_dump_traceback_later()
        seed += 1
        if (status and not keep_going) or time.monotonic() >= end:
            break
    print(f"\r{part}: {seed - first} cases from --seed {first}", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
