"""faintspot slopes, killed or interrupted in mid-run and started again: as if nothing had happened."""

import json
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import LAYOUT, Commands, assert_equal, simulated
from tests.engine.commands import start

from faintspot import Settings, SlopePipeline, Slopes

pytest.importorskip("zarr")

pytestmark = pytest.mark.slow

N_FRAMES = 2000  # five chunks of a store, the last one short; a mark after each
ITERATIONS = 500  # so that a run takes some seconds, and no signal comes after its end
SETTINGS = Settings(noise_std=2.0, keep_brightest=10, tolerance=0.0, max_iterations=ITERATIONS)
SMALL_CHUNKS = """
import sys
from faintspot.cli import main
from faintspot.io import slopes_writer
from faintspot.io.formats import zarr_files
zarr_files._CHUNK_NUMBERS, slopes_writer._MARK_SECONDS = 450 * 16, 0.0
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return np.tile(simulated(100), (N_FRAMES // 100, 1, 1))


@pytest.fixture(scope="module")
def uninterrupted(frames: np.ndarray) -> Slopes:
    few = SlopePipeline(LAYOUT, SETTINGS)(frames[:100])
    tiled = {name: np.tile(array, (N_FRAMES // 100, 1)) for name, array in few.variables.items()}
    return Slopes.from_variables(tiled)


def finished(output: Path) -> int:
    """Return how many frames the unfinished output says it has."""
    store = output if output.suffix == ".zarr" else output.with_name(f"{output.name}.partial.zarr")
    try:
        return int(json.loads((store / "zarr.json").read_text())["attributes"]["finished_frames"])
    except FileNotFoundError:
        return 0


def start_and_stop(output: Path, number: int) -> tuple[int, str]:
    """Start the command, send it a signal when some of its frames are stored; exit code and errors."""
    options = ("slopes", "a.npy", "-o", output.name, "--block", "50", "--threads", "1")
    process = start(SMALL_CHUNKS, *options, cwd=output.parent)
    try:
        end = time.monotonic() + 300  # with compiling
        while not finished(output) and process.poll() is None and time.monotonic() < end:
            time.sleep(0.002)
        process.send_signal(number)
        errors = process.communicate(timeout=60)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, errors


@pytest.fixture
def prepared(folder: Path, frames: np.ndarray) -> Path:
    np.save(folder / "a.npy", frames)
    text = (folder / "faintspot.toml").read_text()
    (folder / "faintspot.toml").write_text(text + f"tolerance = 0.0\nmax_iterations = {ITERATIONS}\n")
    return folder


@pytest.mark.parametrize("name", ["s.zarr", "s.npz"])
def test_a_killed_run_is_resumed(prepared: Path, run: Commands, name: str, uninterrupted: Slopes) -> None:
    output = prepared / name
    code, _ = start_and_stop(output, signal.SIGKILL)
    assert code == -signal.SIGKILL
    kept = finished(output)
    assert 0 < kept < N_FRAMES
    assert name == "s.zarr" or not output.exists()
    result = run.ok("slopes", "a.npy", "-o", name)
    assert f"went on at frame {kept} " in result.out
    assert_equal(output, uninterrupted)


def test_interrupted_run_is_resumed(prepared: Path, run: Commands, uninterrupted: Slopes) -> None:
    output = prepared / "s.zarr"
    code, errors = start_and_stop(output, signal.SIGINT)
    assert code == 130
    *bar, message = errors.splitlines()
    assert message.startswith("faintspot: interrupted")
    assert [f"/{N_FRAMES}" in line for line in bar] == [True]
    assert 0 < finished(output) < N_FRAMES
    run.ok("slopes", "a.npy", "-o", "s.zarr")
    assert_equal(output, uninterrupted)
