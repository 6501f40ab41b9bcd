"""The tests of device/ in a process in which Numba simulates CUDA."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from tests.shared_data import ROOT


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments], env=environment, cwd=ROOT, capture_output=True, text=True, timeout=900
    )


def test_kernels_in_the_simulator() -> None:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    finished = run("-m", "pytest", "tests/cuda/device", "-v", "-x", "-p", "no:cacheprovider")
    assert finished.returncode == 0, finished.stdout[-4000:] + finished.stderr[-2000:]
    assert " passed" in finished.stdout
    assert " skipped" not in finished.stdout


def test_cpu_kernels_are_the_same_beside_the_simulator() -> None:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    code = (
        "import numpy as np, faintspot as fs; "
        "frame = np.random.default_rng(1).normal(size=(16, 16)).astype(np.float32); "
        "pipeline = fs.SlopePipeline(fs.Layout.grid((2, 2), pixels=8), fs.Settings(noise_std=0.5)); "
        "print(pipeline(frame).vector.tobytes().hex())"
    )
    command = [sys.executable, "-c", code]
    plain = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    simulated = run("-c", code)
    assert simulated.returncode == 0, simulated.stderr
    assert simulated.stdout == plain.stdout != ""
