"""The simulated telescope: its frames are the loop's simulation, commands act when they should, orders too.

Each `run(1)` publishes a frame while the exposure of the next one, which has begun with it, goes on: what
acts when does not depend on how busy the machine is.
"""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from tests.engine.commands import needs_shared_memory, start
from tests.loop.simulation.loop_cases import faint, plain
from tests.patience import wait_for
from tests.refusals import assert_each_refused, refused
from tests.shared_data import skip_without

import faintspot
import faintspot as fs
from faintspot.base.errors import InputError
from faintspot.base.files import Closing
from faintspot.cli.realtime.control import send
from faintspot.cli.realtime.control import status as show_status
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.requests import TELESCOPE, ControlServer, request, socket_path
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.telescope import (
    TRUTH,
    ObservingConditions,
    SimulatedTelescope,
    commands_of,
)
from faintspot.loop.simulation import LoopRecord, simulate_loop
from faintspot.loop.simulation.engine_files import write_engine_files
from faintspot.loop.simulation.telescope import TelescopeModel, make_pipeline
from faintspot.slopes.pipeline import configuration as configuration_file

skip_without("hcipy")
pyshmem = pytest.importorskip("pyshmem")
pytestmark = [needs_shared_memory, pytest.mark.slow]
CONFIGURATION = faint().replace("control", frame_rate_hz=1000.0)  # runs of single frames take no longer
COMMANDS, PATIENCE_S = 54, 120.0


class Watched(Closing):
    """A telescope, what it has said, and its streams as others see them."""

    def __init__(self, name: str, **options: Any) -> None:
        self.lines: list[str] = []
        self.telescope = SimulatedTelescope(CONFIGURATION, name, say=self.lines.append, **options)
        self.ring = PixelRing.attach(name)
        self._truth = pyshmem.open(f"{name}_truth")
        self._frames = pyshmem.open(f"{name}_frames")

    def frame(self) -> np.ndarray:
        """Let one more frame come."""
        assert self.telescope.run(1).frames == 1
        publication = self._frames.read_publication()
        number = self.ring.progress()[0]
        assert publication.frame_id == number == self.truth["frame"]
        np.testing.assert_array_equal(publication.payload, self.ring.slot(number))
        return np.asarray(publication.payload)

    @property
    def truth(self) -> dict[str, float]:
        publication = self._truth.read_publication()
        return dict(zip(TRUTH, publication.payload.tolist(), strict=True))

    @contextmanager
    def observing(self) -> Iterator[None]:
        """Let frames come in another thread."""
        stop = threading.Event()
        runner = threading.Thread(target=self.telescope.run, args=(None, stop))
        runner.start()
        try:
            yield
        finally:
            stop.set()
            runner.join()

    def close(self) -> None:
        self._truth.close()
        self._frames.close()
        self.telescope.close()


@pytest.fixture
def watched(name: str) -> Iterator[Watched]:
    with Watched(name) as made:
        yield made


@pytest.fixture
def commands(name: str) -> Iterator[Any]:
    stream = pyshmem.create(f"{name}_commands", shape=(COMMANDS,), dtype=np.float64)
    yield stream
    stream.close()


@pytest.fixture(scope="module")
def record() -> LoopRecord:
    return simulate_loop(CONFIGURATION.replace("run", frames=12, settle_frames=2), [plain()])


def test_frames_and_truth_are_the_simulated_loops(
    record: LoopRecord, watched: Watched, commands: Any
) -> None:
    """With the same commands: Strehl ratio and rms, and slopes through the same pipeline, bit for bit."""
    pipeline = make_pipeline(CONFIGURATION, watched.telescope.telescope_model.optics.sensor, plain())
    for number, (slopes, strehl, residual) in enumerate(
        zip(record.slopes_px, record.strehl, record.residual_nm, strict=True)
    ):
        following = min(number + 1, len(record.commands) - 1)  # its exposure begins with this read-out
        commands.write(record.commands[following].astype(np.float64), frame_id=following)
        np.testing.assert_array_equal(pipeline(watched.frame()).vector, slopes)
        assert (watched.truth["strehl"], watched.truth["rms_nm"]) == (strehl, residual)
        assert watched.truth["time_s"] == (number + 0.5) / 1000.0
        assert watched.truth["photons"] == 200.0
    assert np.ptp(record.strehl) > 0.05  # commands do something


def test_an_exposure_waits_for_the_command_that_is_due(name: str, commands: Any) -> None:
    """Of an engine that is slower than the camera; without waiting, older commands act."""
    truths: list[tuple[float, ...]] = []
    with Watched(name, waits=True, keep_truth=truths.append) as watched:
        engine = PixelRing.attach(name, follows=True)
        engine.follow(0)
        with watched.observing():
            for number in range(8):
                wait_for(lambda number=number: engine.last_row_time_ns(number, number + 1) > 0)
                time.sleep(0.02)  # twenty frame times
                commands.write(np.full(COMMANDS, 10.0 * number), frame_id=number)
                engine.follow(number + 1)
        engine.unfollow()
        engine.close()
    acted = [truth[TRUTH.index("command_frame")] for truth in truths]
    assert len(acted) >= 8
    assert acted[2:8] == [0, 1, 2, 3, 4, 5]


def test_each_realisation_has_its_turbulence(name: str) -> None:
    with Watched(name, realisation=1, seed=5) as watched:
        telescope_model = TelescopeModel(CONFIGURATION, 5, 1)
        seen = telescope_model.wavefronts(0.5e-3, np.zeros(COMMANDS))[1]
        np.testing.assert_array_equal(watched.frame(), telescope_model.frame(0, seen))


def test_commands_act_on_the_next_exposure_but_one(watched: Watched, commands: Any) -> None:
    """Computed from a frame that is out, while the next one is being exposed: two frames later."""
    acted = []
    for number in range(8):
        watched.frame()
        acted.append(watched.truth["command_frame"])
        commands.write(np.full(COMMANDS, 10.0 * number), frame_id=number)
    assert acted[2:] == [0, 1, 2, 3, 4, 5]
    counters = watched.telescope.commands.counters
    assert (counters.taken, counters.missed) == (7, 0)
    commands.write(np.zeros(COMMANDS), frame_id=100)
    commands.write(np.ones(COMMANDS), frame_id=101)  # the newest counts
    watched.frame()
    watched.frame()
    assert watched.truth["command_frame"] == 101
    assert counters.missed == 2


def test_a_missing_stream_leaves_the_mirror_flat_and_is_said_once(watched: Watched, name: str) -> None:
    flat = TelescopeModel(CONFIGURATION, CONFIGURATION.run.seed)
    for number in range(3):
        after, _ = flat.wavefronts((number + 0.5) / 1000.0, np.zeros(COMMANDS))
        watched.frame()
        assert watched.truth["rms_nm"] == flat.optics.pupil.rms(after)
        assert watched.truth["command_frame"] == -1
    time.sleep(0.11)  # it looks again
    watched.frame()
    assert watched.lines == [f"stream {name}_commands: is not there; the mirror stays flat"]


def test_the_mirror_keeps_its_commands_while_the_stream_is_gone_or_wrong(watched: Watched, name: str) -> None:
    def stream(length: int) -> Any:
        return pyshmem.create(f"{name}_commands", shape=(length,), dtype=np.float32)

    held, lines = watched.telescope.commands, watched.lines
    first = stream(COMMANDS)
    first.write(np.full(COMMANDS, 30.0), frame_id=7)
    wait_for(lambda: held.frame == 7, step=watched.frame)
    first.unlink()
    wait_for(lambda: "is not there; the mirror keeps its last commands" in lines[-1], step=watched.frame)
    wrong = stream(COMMANDS - 1)
    wrong.write(np.ones(COMMANDS - 1), frame_id=8)
    wait_for(lambda: "holds (53,) float32, expected (54,)" in lines[-1], step=watched.frame)
    assert held.obstacle
    wrong.unlink()
    again = stream(COMMANDS)
    wait_for(lambda: "54 commands (float32)" in lines[-1], step=watched.frame)
    watched.frame()  # nothing is published yet
    assert watched.truth["command_frame"] == 7
    np.testing.assert_array_equal(held.commands_nm, 30.0)
    again.write(np.full(COMMANDS, 31.0), frame_id=9)
    watched.frame()
    watched.frame()
    assert watched.truth["command_frame"] == 9
    assert not held.obstacle
    again.unlink()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e7])
def test_impossible_commands_are_not_taken(watched: Watched, commands: Any, bad: float) -> None:
    values = np.full(COMMANDS, 5.0)
    commands.write(values, frame_id=1)
    watched.frame()
    values[3] = bad
    for number in (2, 3):
        commands.write(values, frame_id=number)
        watched.frame()
    watched.frame()
    assert watched.truth["command_frame"] == 1
    assert watched.telescope.commands.counters.refused == 2
    assert sum("exceed 1e+06 nm; the mirror keeps" in line for line in watched.lines) == 1


def test_a_writer_that_dies_in_the_middle_is_survived(watched: Watched, name: str) -> None:
    code = (
        "import os, sys, numpy as np, pyshmem\n"
        f"stream = pyshmem.create(sys.argv[1], shape=({COMMANDS},), dtype=np.float64)\n"
        f"stream.write(np.ones({COMMANDS}), frame_id=4)\n"
        "view = stream.write_view(frame_id=5).__enter__()\n"
        "view[:] = 100.0\n"
        "os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", code, f"{name}_commands"], check=False, timeout=PATIENCE_S)
    watched.frame()
    assert "54 commands" in watched.lines[-1]
    assert watched.telescope.commands.counters.incomplete >= 1
    assert watched.truth["command_frame"] == -1  # what lies there now is half of one
    pyshmem.unlink(f"{name}_commands")
    successor = pyshmem.create(f"{name}_commands", shape=(COMMANDS,), dtype=np.float64)
    successor.write(np.full(COMMANDS, 2.0), frame_id=6)
    wait_for(lambda: watched.telescope.commands.frame == 6, step=watched.frame)
    successor.unlink()


# ---- orders


def test_orders_take_effect_with_an_exposure(watched: Watched) -> None:
    before = watched.frame()
    order = watched.telescope.order({"photons": 20000.0})
    watched.frame()  # was being exposed when the order came
    assert (order.in_effect.is_set(), order.frame, watched.truth["photons"]) == (True, 2, 200.0)
    brighter = watched.frame()
    assert watched.truth["photons"] == 20000.0
    # 36 sub-apertures: 100 times the flux within 20 %; Poisson noise is below 2 %, the rest is speckle.
    assert brighter.sum() == pytest.approx(100 * before.sum(), rel=0.2)
    watched.telescope.order({"r0_m": 0.05})
    watched.telescope.order({"wind_factor": 2.0})  # both count
    watched.frame()
    assert watched.truth["r0_m"] == pytest.approx(0.15)
    watched.frame()
    assert watched.truth["r0_m"] == pytest.approx(0.05)
    assert watched.telescope.status()["conditions"] == {
        "photons": 20000.0,
        "r0_m": (0.05, 0.05),
        "wind_factor": 2.0,
    }
    expected = 2 * TelescopeModel(CONFIGURATION, CONFIGURATION.run.seed).atmosphere.velocity
    np.testing.assert_array_equal(watched.telescope.telescope_model.atmosphere.velocity, expected)


def test_magnitude_and_seeing_are_converted() -> None:
    now = ObservingConditions.of(CONFIGURATION).ordered(
        CONFIGURATION, {"magnitude": 10, "seeing_arcsec": [1.0, 0.5]}
    )
    assert now.photons == pytest.approx(float(CONFIGURATION.photometry.electrons(10.0)))
    assert now.r0_m == pytest.approx((0.1007, 0.2013), rel=1e-3)  # 0.976 x 500 nm / 1 arcsec


def test_conditions_out_of_range_are_refused() -> None:
    def ordered(**changes: Any) -> None:
        ObservingConditions.of(CONFIGURATION).ordered(CONFIGURATION, {"wind_factor": 3.0, **changes})

    assert_each_refused(
        ordered,
        photons=[-1, None, float("nan")],
        magnitude=["bright"],
        r0_m=[0, [0.1, 0.2, 0.3], None],
        seeing_arcsec=[0],
        wind_factor=[-1],
    )
    for changes, text in (
        ({"magnitude": -30}, "photons = "),
        ({"photons": 1, "magnitude": 1}, "photons and magnitude"),
        ({"r0_m": 1, "seeing_arcsec": 1}, "r0_m and seeing_arcsec"),
        ({"phtons": 1}, "phtons: unknown order; did you mean photons"),
    ):
        with refused(text):
            ordered(**changes)


def test_a_bad_order_changes_nothing(watched: Watched) -> None:
    before = watched.telescope.status()["conditions"]
    with pytest.raises(InputError):
        watched.telescope.order({"wind_factor": 3.0, "photons": -1})
    watched.frame()
    watched.frame()
    assert watched.telescope.status()["conditions"] == before


def test_commands_over_the_socket(watched: Watched, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = socket_path(name, TELESCOPE)
    with ControlServer(path, commands_of(watched.telescope)), watched.observing():
        reply = request(path, "set", changes={"photons": 50, "r0_m": [0.1, 0.2]}, timeout_s=PATIENCE_S)
        assert reply["frame"] is None or reply["frame"] >= 0
        assert reply["conditions"] == {"photons": 50, "r0_m": [0.1, 0.2], "wind_factor": 1}
        with pytest.raises(InputError, match="changes: expected values by name"):
            request(path, "set", changes=[])
        asked = ["--telescope", "--name", name]
        said = CliRunner().invoke(send, ["--telescope", "wind_factor=2", "--name", name])
        assert "50 photons, r0 0.1 to 0.2 m, winds x 2" in said.output
        wait_for(lambda: request(path, "status")["truth"] is not None)
        said = CliRunner().invoke(show_status, asked)
        for text in ("canary", "1000 a second", "is not there", "Strehl ratio 0."):
            assert text in said.output
        status = json.loads(CliRunner().invoke(show_status, [*asked, "--json"]).output)
        assert tuple(status["truth"]) == TRUTH
    for command, options in ((send, ["photons=1"]), (show_status, [])):
        refused = CliRunner().invoke(command, [*options, "--telescope", "--name", name])
        assert isinstance(refused.exception, InputError)
        assert "faintspot realtime telescope starts one" in str(refused.exception)


# ---- pace, ends and restarts


def test_a_pace_that_cannot_be_kept_is_counted_and_said(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every exposure takes 5 frame times at least, whatever else the machine does."""
    simulated = TelescopeModel.frame

    def slow(self: TelescopeModel, *arguments: Any) -> np.ndarray:
        time.sleep(0.005)
        return simulated(self, *arguments)

    monkeypatch.setattr(TelescopeModel, "frame", slow)
    report = watched.telescope.run(6)
    assert report.frames == 6
    assert report.overruns >= 4 * 5
    assert report.late >= 5
    assert sum("cannot keep 1000 frames/s: " in line for line in watched.lines) == 1
    assert watched.telescope.status()["overruns"] == report.overruns


def test_two_of_one_name_and_nothing_left_behind(watched: Watched, name: str) -> None:
    watched.frame()
    with pytest.raises(InputError, match="already writes into this pixel ring"):
        SimulatedTelescope(CONFIGURATION, name)
    watched.telescope.close()
    watched.telescope.close()
    assert not (FOLDER / name).exists()
    assert not {f"{name}_truth", f"{name}_frames"} & set(pyshmem.list_streams())
    with SimulatedTelescope(CONFIGURATION, name) as again:
        assert again.run(1).frames == 1
    with pytest.raises(InputError, match="rows_per_block"):
        SimulatedTelescope(CONFIGURATION, name, rows_per_block=0)
    assert not (FOLDER / name).exists()


def started(name: str, *options: str) -> subprocess.Popen[str]:
    """Start the command; returns when it has published frames."""
    code = "from faintspot.cli.realtime.telescope import telescope; telescope()"
    process = start(code, "canary", "--name", name, "--frame-rate-hz", "100", *options)
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            ring = PixelRing.attach(name)
            if ring.creator_pid == process.pid and ring.progress()[0] >= 2:
                return process
        except InputError:
            pass
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


def test_killed_and_restarted_then_ended_in_order(name: str, tmp_path: Path) -> None:
    """The commands that a controller has sent act on; streams and socket are taken over and released."""
    stream = pyshmem.create(f"{name}_commands", shape=(COMMANDS,), dtype=np.float32)
    stream.write(np.zeros(COMMANDS), frame_id=77)
    killed = started(name)
    killed.kill()
    killed.communicate(timeout=PATIENCE_S)
    process = started(name, "--write-config", str(tmp_path / "bench"))
    truth = pyshmem.open(f"{name}_truth")
    assert dict(zip(TRUTH, truth.read().tolist(), strict=True))["command_frame"] == 77
    assert request(socket_path(name, TELESCOPE), "status", timeout_s=PATIENCE_S)["configuration"] == "canary"
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "54 commands, 100 frames/s" in out
    assert "frame times without a frame" in out.splitlines()[-1]
    assert (tmp_path / "bench" / "faintspot.toml").is_file()
    assert not (FOLDER / name).exists()
    assert not {f"{name}_truth", f"{name}_frames"} & set(pyshmem.list_streams())
    assert not socket_path(name, TELESCOPE).exists()
    stream.unlink()


# ---- a loop


def test_files_keep_what_else_there_is(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    path.write_text('# mine\n[estimator]\nname = "centroid"\n')
    assert write_engine_files(CONFIGURATION, tmp_path) == path
    known = configuration_file.Configuration(path)
    assert known.settings.estimator.name == "centroid"
    assert "# mine" in path.read_text()
    assert known.psf is not None
    assert (len(known.layout), known.calibration.read_noise_e) == (36, 1.0)
    reference = np.load(tmp_path / "reference_slopes.npy")
    assert reference.shape == (72,)
    method = faintspot.loop.simulation.Method("-", known.settings)
    sensor = TelescopeModel(CONFIGURATION, 1).optics.sensor
    frame = sensor.frame(sensor.spots(np.zeros((sensor.points,) * 2, np.float32))) * 1e6
    plain_slopes = fs.SlopePipeline(known.layout, known.settings, fs.Calibration(0.0), reference)(frame)
    np.testing.assert_allclose(plain_slopes.vector, 0, atol=1e-5)
    assert make_pipeline(CONFIGURATION, sensor, method).layout.frame_shape == known.layout.frame_shape
    with pytest.raises(InputError, match="cannot be written"):
        write_engine_files(CONFIGURATION, path / "inside_a_file")
