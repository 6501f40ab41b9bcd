import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io.slope_files import assert_alone, assert_stored, part, result, store_of, write, writer_for
from tests.shared_data import ROOT

import faintspot
from faintspot.io import read_slopes, slopes_writer
from faintspot.io.formats import zarr_files

pytestmark = pytest.mark.slow


KILLED = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from faintspot.io.formats import zarr_files
from tests.io import slope_files as t
zarr_files._CHUNK_NUMBERS = 70
whole = t.result(1000)
print("ready", flush=True)
t.write(Path(sys.argv[1]), whole, 3)
"""


@pytest.mark.parametrize("name", ["slopes.zarr", "slopes.npz"])
def test_killed_again_and_again(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    whole = result(1000)
    package = Path(faintspot.__file__).parents[1]
    n_finished = [0]
    for attempt in range(2):
        arguments = [sys.executable, "-c", KILLED, str(path), str(package), str(ROOT)]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            end = time.monotonic() + 20
            while finished(store_of(path)) <= n_finished[-1] and time.monotonic() < end:
                time.sleep(0.002)
            time.sleep(0.01 * attempt)
            process.send_signal(signal.SIGKILL)
        stored = read_slopes(store_of(path))
        for variable, array in stored.variables.items():
            np.testing.assert_array_equal(array, whole[variable][: stored.n_finished])
        n_finished.append(stored.n_finished)
    assert n_finished == sorted(set(n_finished))
    write(path, whole, 100)
    assert_alone(path, whole)


def finished(store: Path) -> int:
    """Return how many frames a store states."""
    try:
        return int(json.loads((store / "zarr.json").read_text())["attributes"]["finished_frames"])
    except FileNotFoundError:
        return 0


@pytest.mark.parametrize("line", range(14))
def test_ctrl_c_at_any_line_of_the_writer(tmp_path: Path, line: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever line is reached when the signal comes, no frame is stored twice or lost."""
    monkeypatch.setattr(zarr_files, "_CHUNK_NUMBERS", 70)
    monkeypatch.setattr(slopes_writer, "_MARK_SECONDS", 0.0)
    whole, n_lines = result(), -1

    def trace(frame: Any, event: str, _: Any) -> Any:
        nonlocal n_lines
        code = frame.f_code
        if code.co_filename != slopes_writer.__file__ or code.co_name not in ("append", "_store_waiting"):
            return None
        if event != "line":
            return trace
        n_lines += 1
        if n_lines == line + 20:  # in the second block, which fills a chunk
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    def interrupted() -> None:
        with writer_for(tmp_path / "slopes.zarr") as writer:
            sys.settrace(trace)
            for start in range(0, 50, 8):
                writer.append(start, part(whole, start, min(start + 8, 50)))

    before = sys.gettrace()
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
    finally:
        sys.settrace(before)
    write(tmp_path / "slopes.zarr", whole)
    assert_stored(tmp_path / "slopes.zarr", whole)
