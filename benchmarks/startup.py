"""How long it takes to get going: import, first call with the compiled kernels on disk, first call without.

Every sample is a process of its own; that of a bare interpreter (`python -c pass`), taken in the same turn,
is subtracted. The best sample is given: interference only adds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

import numpy as np

from benchmarks.measuring import Candidate, Row, Table, interleaved

_IMPORT = "import faintspot"
_DENOISE = """
import numpy as np, faintspot as fs
image = np.random.default_rng(1).normal(size=(16, 16)).astype(np.float32)
fs.tv_denoise(image, noise_std=0.5)
"""
_PIPELINE = """
import numpy as np, faintspot as fs
layout = fs.Layout.grid((7, 7), pixels=16)
frame = np.random.default_rng(1).normal(size=layout.frame_shape).astype(np.float32)
fs.SlopePipeline(layout, fs.Settings(noise_std=0.5))(frame)
"""


def _process(code: str, cache: str | None = None) -> Candidate:
    """Return a run of code in a new process; with `cache`, compiled kernels are looked for there only."""
    environment = os.environ | ({} if cache is None else {"NUMBA_CACHE_DIR": cache})

    def run() -> None:
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)

    return run


def _cold(code: str) -> Candidate:
    """Return a run of code in a new process that finds no compiled kernel."""

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            _process(code, folder)()

    return run


def _rows(names: dict[str, tuple[Candidate, float | None]], fewest: int) -> list[Row]:
    candidates = {name: candidate for name, (candidate, _) in names.items()}
    times = interleaved({"pass": _process("pass")} | candidates, seconds=0.0, fewest=fewest)
    rows = []
    for name, (_, target) in names.items():
        beyond = times[name] - times["pass"]
        values = {"best s": float(beyond.min()), "median s": float(np.median(beyond))}
        met = None if target is None else bool(beyond.min() < target)
        rows.append(Row(name, values, "" if target is None else f"< {target:g} s", met))
    return rows


def run() -> list[Table]:
    """Measure all three."""
    rows = _rows(
        {
            "import faintspot": (_process(_IMPORT), 0.5),
            "warm cache: import, tv_denoise of one image": (_process(_DENOISE), 1.0),
            "warm cache: import, SlopePipeline on one frame": (_process(_PIPELINE), 1.0),
            "of which import numpy": (_process("import numpy"), None),
            "of which import numba": (_process("import numba"), None),
        },
        fewest=7,
    )
    rows += _rows(
        {
            "cold cache: tv_denoise of one image": (_cold(_DENOISE), None),
            "cold cache: SlopePipeline on one frame": (_cold(_PIPELINE), None),
        },
        fewest=1,
    )
    return [Table("startup", "A new process, beyond a bare interpreter", rows)]
