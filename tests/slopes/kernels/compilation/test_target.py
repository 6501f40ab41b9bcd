"""Kernels use what the processor has that Numba compiles for, which may be less than this machine's."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.shared_data import ROOT

from faintspot import Layout, Settings, SlopePipeline
from faintspot.slopes.kernels.compilation.compiling import compile_target

LAYOUT = Layout.grid((2, 2), pixels=8)
SETTINGS = Settings("tv", noise_std=3.0, keep_brightest=20)
_MEASURE = """
import json
from tests.slopes.kernels.compilation import test_target as here
from faintspot.slopes.kernels.compilation.host import lanes_for
from faintspot.slopes.kernels.compilation.compiling import vector_registers
target, width = here.compile_target(), lanes_for("float32").width
print(json.dumps([target.cpu, sorted(target.features), width, vector_registers(), here.slopes().tolist()]))
"""


def slopes() -> np.ndarray:
    """Slopes of spots that are bright against their noise."""
    y, x = np.mgrid[:8, :8] - 3.5
    spot = 300 * np.exp(-((x - 0.3) ** 2 + (y + 0.6) ** 2) / 4)
    frame = np.tile(spot, (2, 2)) + np.random.default_rng(1).normal(0, 3, (16, 16))
    return SlopePipeline(LAYOUT, SETTINGS)(frame.astype(np.float32)).vector


def test_target_of_this_process() -> None:
    target = compile_target()
    assert target.triple.count("-") >= 2
    assert target.cpu
    assert all(name and name[0] not in "+-" for name in target.features)


@pytest.mark.slow
def test_generic_processor(tmp_path: Path) -> None:
    """As on clusters whose nodes differ; code for more than the target has would end the process."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "FAINTSPOT_SIMD"))
    }
    environment |= {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    done = subprocess.run(
        [sys.executable, "-c", _MEASURE], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    cpu, features, width, registers, found = json.loads(done.stdout)
    assert (cpu, features, width) == ("generic", [], 4)
    assert registers == (32 if compile_target().triple.startswith("aarch64") else 16)
    # float32 rounding (6e-8) over 7 px, summed over 64 pixels and some tens of iterations.
    np.testing.assert_allclose(found, slopes(), atol=2e-5)
