"""How long it takes to get going: import, first call with the compiled kernels on disk, first call without.

Every sample is a process of its own; that of a bare interpreter (`python -c pass`), taken in the same turn,
is subtracted. The best sample is given: interference only adds. Without compiled kernels there is one
sample.
"""

import os
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmarks.measuring import Candidate, Row, Table, absolute_spread, interleaved

TURNS = 7
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
_BRIGHTEST = _PIPELINE.replace("noise_std=0.5", "estimator='brightest'")


def _process(code: str, cache: str | None = None) -> Candidate:
    """Return a run of code in a new process; with `cache`, compiled kernels are looked for there only."""
    environment = os.environ | ({} if cache is None else {"NUMBA_CACHE_DIR": cache})

    def run() -> None:
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)

    return run


def _cold_row(name: str, code: str) -> Row:
    """Run code once in a new process that finds no compiled kernel; compiling takes long enough."""
    start = time.perf_counter()
    _process("pass")()
    middle = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        _process(code, folder)()
    return Row(name, {"best s": time.perf_counter() - middle - (middle - start)})


def _rows(names: dict[str, tuple[Candidate, float | None]]) -> list[Row]:
    candidates = {name: candidate for name, (candidate, _) in names.items()}
    times = interleaved({"pass": _process("pass")} | candidates, seconds=0.0, fewest=TURNS)
    rows = []
    for name, (_, target) in names.items():
        beyond = times[name] - times["pass"]
        values = {"best s": float(beyond.min()), "median s": float(np.median(beyond))}
        met = None if target is None else bool(beyond.min() < target)
        # Absolute times, so that compare.py takes them for worse only when they are so by far.
        known = {"best s": absolute_spread({name: beyond}, name)}
        rows.append(Row(name, values, "" if target is None else f"< {target:g} s", met, known, "lower"))
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
        }
    )
    rows.append(_cold_row("cold cache, once: tv_denoise of one image", _DENOISE))
    rows.append(_cold_row("cold cache, once: SlopePipeline on one frame", _PIPELINE))
    rows.append(_cold_row("cold cache, once: the same without denoising", _BRIGHTEST))
    return [Table("startup", "A new process, beyond a bare interpreter", rows)]
