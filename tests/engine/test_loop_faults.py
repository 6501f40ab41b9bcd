"""What goes wrong around a closed loop: clocks, a stream of commands that is taken away, a full disk."""

import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.shared_data import skip_without

from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.streams.shared_streams import _base
from faintspot.io import read_telemetry
from faintspot.loop.control.configuration import Control

skip_without("hcipy")
pyshmem = pytest.importorskip("pyshmem")

from tests.engine.closed_loop import COMMANDS, PATIENCE_S, Sky, make_engine  # noqa: E402
from tests.patience import wait_for  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture
def sky(sky: Sky, files: tuple[Path, Control]) -> Sky:
    """With an engine that closes its loop."""
    sky.start(make_engine(sky.name, *files))
    sky.loop.close()
    sky.frames(6)
    return sky


def check_commands(sky: Sky, control: Control) -> None:
    """All frames came, and each has moved the mirror by what an integrator makes of its slopes."""
    records, options = sky.records, control.options
    frames = len(records)
    assert records["frame"].tolist() == list(range(frames))
    assert set(records["loop"]) == {2}
    slopes = np.hstack([records["x"], records["y"]]) / options.centroid_gain
    sent = np.vstack([np.zeros(COMMANDS), records["commands"]]).astype(np.float64)
    expected = (1 - options.leak) * sent[:-1] - options.gain * slopes @ control.reconstructor.matrix.T
    np.testing.assert_allclose(sent[1:], expected, rtol=0, atol=0.01)


@pytest.mark.parametrize("jump_s", [-1e7, 1e7])
def test_the_clock_jumps(
    sky: Sky, files: tuple[Path, Control], jump_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    true_s, true_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: true_s() + jump_s)
    monkeypatch.setattr(time, "time_ns", lambda: true_ns() + round(jump_s * 1e9))
    assert sky.frames(30)[20:].mean() > 0.4
    check_commands(sky, files[1])
    records = sky.records
    assert (np.diff(records["last_row_time_ns"]) > 0).all()
    assert (records["published_time_ns"] > records["last_row_time_ns"]).all()
    assert (sky.loop.latencies.as_dict()["max_us"] or 0) < PATIENCE_S * 1e6


def frames_until(sky: Sky, condition: Callable[[], bool], pause_s: float = 0.0) -> None:
    """Let frames come until something is so."""

    def step() -> None:
        sky.frame()
        time.sleep(pause_s)

    wait_for(condition, step=step)


def segments(sky: Sky) -> list[Path]:
    return [FOLDER / f"{_base(f'{sky.name}_commands')}{part}" for part in ("", "_meta")]


def maker(sky: Sky) -> int | None:
    """Return the process that has made the stream of commands that is there."""
    try:
        return int(pyshmem.stat(f"{sky.name}_commands")["creator_pid"])
    except (FileNotFoundError, ValueError):
        return None


def renewed(sky: Sky) -> int:
    assert sky.running is not None
    return sky.running.engine.counters.commands_renewed


def obstacle(sky: Sky) -> str:
    assert sky.running is not None
    return str(sky.running.engine.loop_status()["obstacle"])


def test_the_stream_of_commands_is_removed(sky: Sky, files: tuple[Path, Control]) -> None:
    """The engine makes it anew, the mirror follows the new one, and the loop goes on."""
    for path in segments(sky):
        path.unlink()
    assert "was removed" in obstacle(sky)
    frames_until(sky, lambda: renewed(sky) == 1)
    frames_until(sky, lambda: sky.frame()["frame"] - sky.frame()["command_frame"] <= 2)
    assert obstacle(sky) == "None"
    assert sky.frames(30)[20:].mean() > 0.4
    check_commands(sky, files[1])


def test_another_program_takes_the_stream_of_commands(
    sky: Sky, files: tuple[Path, Control], tmp_path: Path
) -> None:
    """One with another folder of locks may: the engine leaves it alone and says so, until it has ended."""
    code = (
        "import sys, numpy as np, pyshmem\n"
        f"stream = pyshmem.create(sys.argv[1], shape=({COMMANDS},), dtype='f4')\n"
        "sys.stdin.read()\n"
    )
    for path in segments(sky):
        path.unlink()
    environment = {**os.environ, "PYSHMEM_LOCK_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", code, f"{sky.name}_commands"], env=environment, stdin=subprocess.PIPE
    ) as other:
        try:
            sky.until(lambda: maker(sky) == other.pid)
            sky.frames(5)
            time.sleep(0.5)  # for the watcher to look twice
            sky.frames(5)
            assert renewed(sky) == 0
            assert "another program" in obstacle(sky)
        finally:
            other.kill()
    frames_until(sky, lambda: renewed(sky) == 1)
    sky.frames(5)
    check_commands(sky, files[1])


RECORD = [sys.executable, "-m", "faintspot", "realtime", "record", "night.zarr"]
TMPFS = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs"]
IN_A_SMALL_FILE_SYSTEM = f"""
{" ".join(TMPFS)} "$0" && cd "$0" || exit
"$@"
code=$?
cp -r night.zarr "$0.kept"
exit $code
"""
"""In a mount namespace of its own, so that nobody else sees it, and it goes with the process."""
UNSHARE = ["unshare", "--user", "--map-root-user", "--mount"]
LARGEST_FILE, PAUSE_S = 60_000, 0.01
REASONS = {"disk": "the disk is full", "file": "File too large"}


def mounts(folder: Path) -> bool:
    """Whether this user may mount a small file system."""
    if shutil.which("unshare") is None:
        return False
    tried = subprocess.run([*UNSHARE, *TMPFS, str(folder)], capture_output=True, timeout=PATIENCE_S)
    return tried.returncode == 0


@pytest.mark.parametrize("full", ["disk", "file"])
def test_no_space_for_a_recording(sky: Sky, files: tuple[Path, Control], full: str, tmp_path: Path) -> None:
    """A file system of 300 kB is full, or files may not be larger than 60 kB.

    The recorder says so in a line, what it had written before is whole, and the loop goes on.
    """
    pytest.importorskip("zarr")
    disk = tmp_path / "disk"
    disk.mkdir()
    command, store, limit = [*RECORD, "--name", sky.name], disk / "night.zarr", None
    if full == "disk":
        if not mounts(disk):
            pytest.skip("needs the right to mount a file system")
        command, store = (
            [*UNSHARE, "sh", "-c", IN_A_SMALL_FILE_SYSTEM, str(disk), *command],
            tmp_path / "disk.kept",
        )
    else:
        limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))  # noqa: E731
    first = len(sky.records)
    with subprocess.Popen(
        command, cwd=disk, preexec_fn=limit, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as recorder:
        try:
            frames_until(sky, lambda: recorder.poll() is not None, PAUSE_S)  # else records are overwritten
            assert recorder.stderr is not None
            said = recorder.stderr.read()
        finally:
            recorder.kill()
    assert recorder.returncode == 2, said
    kept = read_telemetry(store)
    assert len(kept.frame) > 0
    assert f"cannot be written: {REASONS[full]}" in said
    assert said.rstrip().endswith(f"; {len(kept.frame)} frames are in the store")
    assert len([line for line in said.splitlines() if "error" in line]) == 1
    sky.frames(5)
    records = sky.records
    same = records[np.isin(records["frame"], kept.frame)]
    assert kept.frame[0] >= first
    np.testing.assert_array_equal(kept.frame, same["frame"])
    np.testing.assert_array_equal(kept.commands, same["commands"])
    np.testing.assert_array_equal(kept.x, same["x"])
    check_commands(sky, files[1])
