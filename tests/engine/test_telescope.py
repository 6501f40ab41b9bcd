"""The simulated telescope: its frames are the loop's simulation, commands act when they should, orders too.

Each `run(1)` publishes a frame while the exposure of the next one, which has begun with it, goes on: what
acts when does not depend on how busy the machine is.
"""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from tests.engine.commands import needs_shared_memory, start
from tests.loop.simulation.loop_cases import faint, plain
from tests.patience import wait_for
from tests.refusals import refused
from tests.shared_data import skip_without

from faintspot.base.errors import InputError
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
from faintspot.loop.simulation.telescope import TelescopeModel, make_pipeline

skip_without("hcipy")
pyshmem = pytest.importorskip("pyshmem")

from tests.engine.closed_loop import COMMANDS, Sky  # noqa: E402

pytestmark = [needs_shared_memory, pytest.mark.slow]
CONFIGURATION = faint().replace("control", frame_rate_hz=1000.0)  # runs of single frames take no longer
PATIENCE_S = 120.0


@pytest.fixture
def watched(name: str) -> Iterator[Sky]:
    with Sky(name, CONFIGURATION) as made:
        yield made


@pytest.fixture
def commands(name: str) -> Iterator[Any]:
    stream = pyshmem.create(f"{name}_commands", shape=(COMMANDS,), dtype=np.float64)
    yield stream
    stream.close()


@pytest.fixture(scope="module")
def record() -> LoopRecord:
    return simulate_loop(CONFIGURATION.replace("run", frames=12, settle_frames=2), [plain()])


def test_frames_and_truth_are_the_simulated_loops(record: LoopRecord, watched: Sky, commands: Any) -> None:
    """With the same commands: Strehl ratio and rms, and slopes through the same pipeline, bit for bit."""
    ring = PixelRing.attach(watched.name)
    pipeline = make_pipeline(CONFIGURATION, watched.telescope.telescope_model.optics.sensor, plain())
    for number, (slopes, strehl, residual) in enumerate(
        zip(record.slopes_px, record.strehl, record.residual_nm, strict=True)
    ):
        following = min(number + 1, len(record.commands) - 1)  # its exposure begins with this read-out
        commands.write(record.commands[following].astype(np.float64), frame_id=following)
        assert watched.frame()["frame"] == ring.progress()[0] == number
        np.testing.assert_array_equal(watched.pixels, ring.slot(number))
        np.testing.assert_array_equal(pipeline(watched.pixels).vector, slopes)
        assert (watched.truth["strehl"], watched.truth["rms_nm"]) == (strehl, residual)
        assert watched.truth["time_s"] == (number + 0.5) / 1000.0
        assert watched.truth["photons"] == 200.0
    assert np.ptp(record.strehl) > 0.05  # commands do something


def test_an_exposure_waits_for_the_command_that_is_due(name: str, commands: Any) -> None:
    """Of an engine that is slower than the camera; without waiting, older commands act."""
    truths: list[tuple[float, ...]] = []
    with Sky(name, CONFIGURATION, waits=True, keep_truth=truths.append, realisation=1, seed=5) as watched:
        telescope_model = TelescopeModel(CONFIGURATION, 5, 1)
        wavefront = telescope_model.wavefronts(0.5e-3, np.zeros(COMMANDS))[1]
        engine = PixelRing.attach(name, follows=True)
        engine.follow(0)
        with watched.observing():
            for number in range(8):
                wait_for(lambda number=number: engine.last_row_time_ns(number, number + 1) > 0)
                if number == 0:  # each realisation has its turbulence
                    np.testing.assert_array_equal(engine.slot(0), telescope_model.frame(0, wavefront))
                time.sleep(0.02)  # twenty frame times
                commands.write(np.full(COMMANDS, 10.0 * number), frame_id=number)
                engine.follow(number + 1)
        engine.unfollow()
        engine.close()
    acted = [truth[TRUTH.index("command_frame")] for truth in truths]
    assert len(acted) >= 8
    assert acted[2:8] == [0, 1, 2, 3, 4, 5]


def test_the_mirror_keeps_its_commands_while_the_stream_is_gone_or_wrong(watched: Sky, name: str) -> None:
    def stream(length: int) -> Any:
        return pyshmem.create(f"{name}_commands", shape=(length,), dtype=np.float32)

    held, lines = watched.telescope.commands, watched.lines
    flat = TelescopeModel(CONFIGURATION, CONFIGURATION.run.seed)
    for number in range(3):
        after, _ = flat.wavefronts((number + 0.5) / 1000.0, np.zeros(COMMANDS))
        watched.frame()
        assert watched.truth["rms_nm"] == flat.optics.pupil.rms(after)
        assert watched.truth["command_frame"] == -1
    assert lines == [f"stream {name}_commands: is not there; the mirror stays flat"]
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


def test_impossible_commands_are_not_taken(watched: Sky, commands: Any) -> None:
    values = np.full(COMMANDS, 5.0)
    commands.write(values, frame_id=1)
    watched.frame()
    for number, bad in ((2, np.nan), (3, np.inf), (4, -1e7)):
        values[3] = bad
        commands.write(values, frame_id=number)
        watched.frame()
    watched.frame()
    assert watched.truth["command_frame"] == 1
    assert watched.telescope.commands.counters.refused == 3
    assert sum("exceed 1e+06 nm; the mirror keeps" in line for line in watched.lines) == 1


# ---- orders


def test_orders_take_effect_with_an_exposure(watched: Sky) -> None:
    watched.frame()
    before = watched.pixels
    order = watched.telescope.order({"photons": 20000.0})
    watched.frame()  # was being exposed when the order came
    assert (order.in_effect.is_set(), order.frame, watched.truth["photons"]) == (True, 2, 200.0)
    watched.frame()
    assert watched.truth["photons"] == 20000.0
    # 36 sub-apertures: 100 times the flux within 20 %; Poisson noise is below 2 %, the rest is speckle.
    assert watched.pixels.sum() == pytest.approx(100 * before.sum(), rel=0.2)
    watched.telescope.order({"r0_m": 0.05})
    watched.telescope.order({"wind_factor": 2.0})  # both count
    watched.frame()
    assert watched.truth["r0_m"] == pytest.approx(0.15)
    watched.frame()
    assert watched.truth["r0_m"] == pytest.approx(0.05)
    with refused("photons"):  # none of both
        watched.telescope.order({"wind_factor": 3.0, "photons": -1})
    now = {"photons": 20000.0, "r0_m": (0.05, 0.05), "wind_factor": 2.0}
    assert watched.telescope.status()["conditions"] == now
    expected = 2 * TelescopeModel(CONFIGURATION, CONFIGURATION.run.seed).atmosphere.velocity
    np.testing.assert_array_equal(watched.telescope.telescope_model.atmosphere.velocity, expected)


def test_magnitude_and_seeing_are_converted() -> None:
    now = ObservingConditions.of(CONFIGURATION).ordered(
        CONFIGURATION, {"magnitude": 10, "seeing_arcsec": [1.0, 0.5]}
    )
    assert now.photons == pytest.approx(float(CONFIGURATION.photometry.electrons(10.0)))
    assert now.r0_m == pytest.approx((0.1007, 0.2013), rel=1e-3)  # 0.976 x 500 nm / 1 arcsec


def test_commands_over_the_socket(watched: Sky, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = socket_path(name, TELESCOPE)
    with ControlServer(path, commands_of(watched.telescope)), watched.observing():
        reply = request(path, "set", changes={"photons": 50, "r0_m": [0.1, 0.2]}, timeout_s=PATIENCE_S)
        assert reply["frame"] is None or reply["frame"] >= 0
        assert reply["conditions"] == {"photons": 50, "r0_m": [0.1, 0.2], "wind_factor": 1}
        with refused("changes"):
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
        answer = CliRunner().invoke(command, [*options, "--telescope", "--name", name])
        assert isinstance(answer.exception, InputError)
        assert "faintspot realtime telescope" in str(answer.exception)


# ---- pace, ends and restarts


def test_two_of_one_name_and_nothing_left_behind(watched: Sky, name: str) -> None:
    watched.frame()
    with refused(name):
        SimulatedTelescope(CONFIGURATION, name)
    watched.telescope.close()
    watched.telescope.close()
    assert not (FOLDER / name).exists()
    assert not {f"{name}_truth", f"{name}_frames"} & set(pyshmem.list_streams())
    with SimulatedTelescope(CONFIGURATION, name) as again:
        assert again.run(1).frames == 1
    with refused("rows_per_block"):
        SimulatedTelescope(CONFIGURATION, name, rows_per_block=0)
    assert not (FOLDER / name).exists()


def test_one_that_was_killed_is_followed_by_another(name: str, tmp_path: Path) -> None:
    """The commands that a controller has sent act on; its ring and streams are taken over."""
    stream = pyshmem.create(f"{name}_commands", shape=(COMMANDS,), dtype=np.float32)
    stream.write(np.zeros(COMMANDS), frame_id=77)
    code = "from faintspot.cli.realtime.telescope import telescope; telescope()"
    options = ["--name", name, "--frame-rate-hz", "100", "--write-config", str(tmp_path / "bench")]
    with start(code, "canary", *options) as process:
        wait_for(lambda: (FOLDER / name).exists() or process.poll() is not None, process.communicate)
        ring = PixelRing.attach(name)
        wait_for(lambda: ring.progress()[0] >= 2)
        assert request(socket_path(name, TELESCOPE), "status")["configuration"] == "canary"
        process.kill()
    assert (tmp_path / "bench" / "faintspot.toml").is_file()
    with Sky(name, CONFIGURATION) as watched, ControlServer(socket_path(name, TELESCOPE), {}):
        watched.frame()
        assert watched.truth["command_frame"] == 77
    stream.unlink()
