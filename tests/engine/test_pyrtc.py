"""pyRTC, in a process of its own, with the engine in its loop: its frames in, its loop on our slopes."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.shared_data import ROOT

import faintspot as fs

EXAMPLE = ROOT / "examples" / "pyrtc_loop.py"
PATIENCE_S = 240.0  # engine and pyRTC may both have to compile

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("pyrtc") is None, reason="needs pyRTC (package pyrtcao)"),
    pytest.mark.skipif(importlib.util.find_spec("pyshmem") is None, reason="needs pyshmem"),
]


def configuration() -> str:
    """Return the configuration that the example writes; importing it would import pyRTC."""
    text = EXAMPLE.read_text()
    quoted = text[text.index('CONFIGURATION = f"""') :].split('"""')[1]
    return quoted.replace("{LEVEL_ADU}", "100")


def test_the_loop_closes_and_slopes_are_the_pipelines(tmp_path: Path) -> None:
    """Slopes that pyRTC reads are those of the pipeline for the frame of that number, bit for bit.

    Closed, the mean slope of 20 frames and 36 spots is within 0.05 px of zero: its noise is below 0.01 px
    and after 3 s at gain 0.2 nothing is left of the 0.94 px tilt.
    """
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = str(Path(fs.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), "out.npz"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (tmp_path / "faintspot.toml").write_text(configuration())
    pipeline = fs.SlopePipeline.from_file(tmp_path / "faintspot.toml")
    with np.load(tmp_path / "out.npz") as stored:
        frames, slopes, tilt = stored["frames"], stored["slopes"], stored["tilt"]
    assert len(frames) >= 40, done.stdout + done.stderr
    for frame, vector in zip(frames, slopes, strict=True):
        assert frame.dtype == np.uint16
        np.testing.assert_array_equal(vector, pipeline(frame).vector)
    np.testing.assert_allclose(tilt[:5].mean(axis=0), (0.8, -0.5), atol=0.1)
    np.testing.assert_allclose(tilt[-20:].mean(axis=0), 0.0, atol=0.05)
