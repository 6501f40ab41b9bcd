"""Frame to command: the loop that an engine closes is the one that is simulated, and what can go wrong."""

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.engine.commands import start
from tests.patience import wait_for
from tests.shared_data import skip_without

from faintspot.engine.processes.requests import request, socket_path
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.streams.shared_streams import _base
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.integrator import CompiledIntegrator
from faintspot.loop.simulation import Method, simulate_loop
from faintspot.slopes.pipeline import configuration as configuration_file

skip_without("hcipy")
pyshmem = pytest.importorskip("pyshmem")

from tests.engine.closed_loop import COMMANDS, CONFIGURATION, PATIENCE_S, Sky, make_engine  # noqa: E402

pytestmark = pytest.mark.slow

FRAMES = 40


def test_the_loop_is_the_simulated_one(sky: Sky, files: tuple[Path, Control]) -> None:
    """Frame by frame: the same air, noise and latency, so the same slopes, commands and Strehl ratios.

    Commands go out as float32, of some hundred nm: to 1e-4 nm, of which each frame adds half to the next. On
    one processor (Intel, Sapphire Rapids) a slope differs in frame 27, probably because a photon count was
    drawn otherwise, and the loops part: by 0.005 in the mean Strehl ratio of the rest.
    """
    path, control = files
    settings = configuration_file.Configuration(path).settings
    run = CONFIGURATION.replace("run", frames=FRAMES, settle_frames=10)
    record = simulate_loop(run, [Method("-", settings, gain=control.options.gain)])
    sky.start(make_engine(sky.name, path, control))
    sky.loop.close()
    strehl = sky.frames(FRAMES)
    records = sky.records
    assert records["frame"].tolist() == list(range(FRAMES))
    assert set(records["loop"]) == {2}
    slopes = np.hstack([records["x"], records["y"]])
    differs = np.abs(slopes - record.slopes_px).max(axis=1) > 1e-3
    same = int(np.argmax(differs)) if differs.any() else FRAMES - 2
    assert same >= 10
    np.testing.assert_allclose(records["commands"][:same], record.commands[2 : same + 2], rtol=0, atol=0.01)
    np.testing.assert_allclose(strehl[:same], record.strehl[:same], rtol=0, atol=1e-4)
    assert strehl[same:].mean() == pytest.approx(record.strehl[same:].mean(), abs=0.02)
    assert strehl[:3].max() < 0.2 < 0.5 < strehl[25:].mean()


def test_the_guard_opens_a_loop_that_diverges(sky: Sky, files: tuple[Path, Control]) -> None:
    """With the wrong sign: the mirror becomes flat, telemetry says why."""
    path, control = files
    options = control.options.replaced({"guard_frames": 10, "largest_command": 500.0})
    sky.start(make_engine(sky.name, path, dataclasses.replace(control, options=options)))
    sky.frames(12)
    assert isinstance(sky.loop.controller, CompiledIntegrator)
    sky.loop.controller.gain = -0.5
    sky.loop.close()
    limit = sky.loop.guard._largest_px
    sky.loop.close()  # again: what is too much stays what the open loop has shown
    assert sky.loop.guard._largest_px == limit
    for _ in range(80):
        sky.frame()
        if not sky.loop.closed:
            break
    assert "diverged: " in sky.loop.opened_because
    sky.frames(2)
    sent = sky.records["commands"]
    assert np.isfinite(sent).all()
    assert 100.0 < np.abs(sent).max() <= 500.0
    assert not sent[-1].any()
    assert sky.running is not None
    telemetry = sky.running.telemetry

    def last_change() -> dict[str, Any]:
        changes = telemetry.changes_since(0)[0]
        return changes[-1]["changes"] if changes else {}

    wait_for(lambda: last_change().get("opened_because") == sky.loop.opened_because)
    assert last_change()["loop"] == "open"


def start_engine(name: str, path: Path, *options: str) -> subprocess.Popen[str]:
    code = "from faintspot.cli.realtime.run import run; run()"
    null = subprocess.DEVNULL
    return start(code, "--config", str(path), "--name", name, *options, stdout=null, stderr=null)


class Commands:
    """The commands of an engine in another process; frames come until it sends its first ones."""

    def __init__(self, sky: Sky, pid: int) -> None:
        self._sky = sky
        sky.until(lambda: self._is_of(pid))
        self._stream = pyshmem.open(f"{sky.name}_commands")
        while not self._stream.count:
            sky.frame()
            time.sleep(0.1)
        self.first = np.array(self._stream.read())

    def _is_of(self, pid: int) -> bool:
        try:
            return bool(pyshmem.stat(f"{self._sky.name}_commands")["creator_pid"] == pid)
        except (FileNotFoundError, ValueError):
            return False

    def frame(self) -> float:
        """Let a frame come, and its commands; return the Strehl ratio."""
        truth = self._sky.frame()
        self._sky.until(lambda: self._stream.read_publication().frame_id >= truth["frame"])
        return truth["strehl"]

    @property
    def last(self) -> np.ndarray:
        return np.array(self._stream.read())


def test_a_killed_engine_is_followed_by_another_without_a_jump(sky: Sky, files: tuple[Path, Control]) -> None:
    """The mirror keeps its last commands; the new engine has them from the first frame on, and goes on."""
    engine = start_engine(sky.name, files[0], "--close-loop")
    try:
        commands = Commands(sky, engine.pid)
        assert max([commands.frame() for _ in range(30)][20:]) > 0.4
    finally:
        engine.kill()
        engine.wait()
    held = commands.last
    number = [sky.frame()["command_frame"] for _ in range(4)][1:]
    assert len(set(number)) == 1
    engine = start_engine(sky.name, files[0])
    try:
        again = Commands(sky, engine.pid)
        np.testing.assert_array_equal(again.first, held)
        assert request(socket_path(sky.name), "loop", action="close")["loop"]["state"] == "closed"
        assert max([again.frame() for _ in range(30)][20:]) > 0.4
        np.testing.assert_array_less(0.0, np.abs(again.last - held).max())
    finally:
        engine.terminate()
        engine.wait()


@pytest.fixture
def closed(sky: Sky, files: tuple[Path, Control]) -> Sky:
    """With an engine that closes its loop."""
    sky.start(make_engine(sky.name, *files))
    sky.loop.close()
    sky.frames(6)
    return sky


def check_commands(closed: Sky, control: Control) -> None:
    """All frames came, and each has moved the mirror by what an integrator makes of its slopes."""
    records, options = closed.records, control.options
    frames = len(records)
    assert records["frame"].tolist() == list(range(frames))
    assert set(records["loop"]) == {2}
    slopes = np.hstack([records["x"], records["y"]]) / options.centroid_gain
    sent = np.vstack([np.zeros(COMMANDS), records["commands"]]).astype(np.float64)
    expected = (1 - options.leak) * sent[:-1] - options.gain * slopes @ control.reconstructor.matrix.T
    np.testing.assert_allclose(sent[1:], expected, rtol=0, atol=0.01)


def test_the_clock_jumps(closed: Sky, files: tuple[Path, Control], monkeypatch: pytest.MonkeyPatch) -> None:
    true_s, true_ns = time.time, time.time_ns
    for jump_s in (-1e7, 1e7):
        monkeypatch.setattr(time, "time", lambda jump_s=jump_s: true_s() + jump_s)
        monkeypatch.setattr(time, "time_ns", lambda jump_s=jump_s: true_ns() + round(jump_s * 1e9))
        closed.frames(10)
    check_commands(closed, files[1])
    records = closed.records
    assert (np.diff(records["last_row_time_ns"]) > 0).all()
    assert (records["published_time_ns"] > records["last_row_time_ns"]).all()
    assert (closed.loop.latencies.as_dict()["max_us"] or 0) < PATIENCE_S * 1e6


def frames_until(closed: Sky, condition: Callable[[], bool]) -> None:
    """Let frames come until something is so."""
    wait_for(condition, step=closed.frame)


def segments(closed: Sky) -> list[Path]:
    return [FOLDER / f"{_base(f'{closed.name}_commands')}{part}" for part in ("", "_meta")]


def maker(closed: Sky) -> int | None:
    """Return the process that has made the stream of commands that is there."""
    try:
        return int(pyshmem.stat(f"{closed.name}_commands")["creator_pid"])
    except (FileNotFoundError, ValueError):
        return None


def renewed(closed: Sky) -> int:
    assert closed.running is not None
    return closed.running.engine.counters.commands_renewed


def obstacle(closed: Sky) -> str:
    assert closed.running is not None
    return str(closed.running.engine.loop_status()["obstacle"])


def test_the_stream_of_commands_is_removed(closed: Sky, files: tuple[Path, Control]) -> None:
    """The engine makes it anew, the mirror follows the new one, and the loop goes on."""
    for path in segments(closed):
        path.unlink()
    assert "was removed" in obstacle(closed)
    frames_until(closed, lambda: renewed(closed) == 1)
    frames_until(closed, lambda: closed.frame()["frame"] - closed.frame()["command_frame"] <= 2)
    assert obstacle(closed) == "None"
    assert closed.frames(20)[10:].mean() > 0.4
    check_commands(closed, files[1])


def test_another_program_takes_the_stream_of_commands(
    closed: Sky, files: tuple[Path, Control], tmp_path: Path
) -> None:
    """One with another folder of locks may: the engine leaves it alone and says so, until it has ended."""
    code = (
        "import sys, numpy as np, pyshmem\n"
        f"stream = pyshmem.create(sys.argv[1], shape=({COMMANDS},), dtype='f4')\n"
        "sys.stdin.read()\n"
    )
    for path in segments(closed):
        path.unlink()
    environment = {**os.environ, "PYSHMEM_LOCK_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", code, f"{closed.name}_commands"], env=environment, stdin=subprocess.PIPE
    ) as other:
        try:
            closed.until(lambda: maker(closed) == other.pid)
            closed.frames(5)
            time.sleep(0.5)  # for the watcher to look twice
            closed.frames(5)
            assert renewed(closed) == 0
            assert "another program" in obstacle(closed)
        finally:
            other.kill()
    frames_until(closed, lambda: renewed(closed) == 1)
    closed.frames(5)
    check_commands(closed, files[1])
