"""The simulated camera: what it publishes is what was simulated, in order, at its rate; it stops and ends."""

import signal
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner
from tests.refusals import assert_each_refused, refused
from tests.simulated import frames_of

from faintspot import Calibration, Layout
from faintspot.base.errors import InputError
from faintspot.base.generators import spawn
from faintspot.cli.realtime.camera import camera
from faintspot.engine.pixels import camera as camera_module
from faintspot.engine.pixels.camera import SimulatedCamera, SpotMotion, readout_type
from faintspot.engine.pixels.pixel_ring import PixelRing
from faintspot.engine.pixels.segment import FOLDER
from faintspot.slopes.simulate import Detector

pytestmark = [
    pytest.mark.skipif(not FOLDER.is_dir(), reason="needs POSIX shared memory as Linux has it"),
    pytest.mark.machine_time("clocks, threads and other processes"),
]

LAYOUT = Layout.grid((3, 4), pixels=8)
CONFIGURATION = "[layout.grid]\nshape = [3, 4]\npixels = 8\n"


@pytest.fixture
def ring(name: str) -> Iterator[PixelRing]:
    with PixelRing.create(name, LAYOUT.frame_shape, np.float32, slots=8) as made:
        yield made


def small(ring: PixelRing, rate: float = 1000.0, seed: int = 3, **options: Any) -> SimulatedCamera:
    return SimulatedCamera(
        LAYOUT, ring, frame_rate_hz=rate, **{"n_distinct": 5, **options}, rng=np.random.default_rng(seed)
    )


def test_frames_are_those_of_the_simulation(ring: PixelRing) -> None:
    detector, motion = Detector(2.0, offset_adu=50.0), SpotMotion(0.5, 0.02)
    source = small(ring, flux_e=300.0, detector=detector, motion=motion, profile="gaussian", size=1.2)
    motion_rng, noise_rng = spawn(np.random.default_rng(3), 2)
    frames, truth = frames_of(
        LAYOUT,
        5,
        flux_e=300.0,
        profile="gaussian",
        size=1.2,
        positions=motion.positions(5, 12, 1000.0, motion_rng),
        detector=detector,
        rng=noise_rng,
    )
    np.testing.assert_array_equal(source.frames, frames)
    np.testing.assert_array_equal(source.truth, truth)
    assert not source.frames.flags.writeable
    reader = PixelRing.attach(ring.name)
    for number in range(12):
        assert source.run(1).frames == 1
        assert reader.progress() == (number, LAYOUT.frame_shape[0])
        np.testing.assert_array_equal(reader.slot(number), frames[number % 5])
    assert source.run(7).frames == 7  # the slots hold the last eight
    for number in range(11, 19):
        assert reader.intact(number)
        np.testing.assert_array_equal(reader.slot(number), frames[number % 5])


@pytest.mark.parametrize("rows_per_block", [1, 5, 24])
def test_rows_come_in_blocks(ring: PixelRing, rows_per_block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    source, seen = small(ring, rows_per_block=rows_per_block), []
    said = PixelRing.rows_ready

    def watched(self: PixelRing, rows: int) -> None:
        said(self, rows)
        seen.append(self.progress())
        frame = source.frames[self.progress()[0]]
        np.testing.assert_array_equal(self.slot(seen[-1][0])[:rows], frame[:rows])

    monkeypatch.setattr(PixelRing, "rows_ready", watched)
    source.run(2)
    steps = [*range(rows_per_block, 24, rows_per_block), 24]
    assert seen == [(number, rows) for number in range(2) for rows in steps]


def test_numbers_and_rows_only_go_forward(ring: PixelRing) -> None:
    source, stop = small(ring, rate=300.0), threading.Event()
    seen: list[tuple[int, int]] = []
    runner = threading.Thread(target=source.run, args=(None, stop))
    runner.start()
    reader = PixelRing.attach(ring.name)
    while runner.is_alive() and (not seen or seen[-1][0] < 30):
        progress = reader.progress()
        if not seen or progress != seen[-1]:
            seen.append(progress)
        time.sleep(1e-4)
    stop.set()
    runner.join()
    # Between two frames the old number with no rows may be seen for an instant.
    ahead = [progress for progress in seen if progress[1] > 0]
    assert ahead == sorted(ahead)
    assert seen[-1][0] >= 30
    assert ring.progress() == (ring.arrivals - 1, 24)


def test_rate(ring: PixelRing) -> None:
    """Within 20 % of the schedule, frame times that other work on the machine took away counted in."""
    report = small(ring, rate=200.0).run(100)
    assert report.frames == 100
    assert report.frame_rate_hz == pytest.approx(report.frames / report.seconds)
    assert (report.frames + report.overruns) / report.seconds == pytest.approx(200.0, rel=0.2)


def test_overruns_are_counted_and_left_behind(ring: PixelRing, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock of its own, where each frame takes 2.5 frame times."""
    now = [0]

    def publish(self: SimulatedCamera, moment: int, frame: object) -> None:
        assert now[0] >= moment
        starts.append(now[0])
        now[0] += 25_000_000 if len(starts) <= 3 else 1_000_000

    def wait_until(moment: int) -> None:
        now[0] = max(now[0], moment)

    starts: list[int] = []
    source = small(ring, rate=100.0)
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])
    monkeypatch.setattr(camera_module, "_wait_until", wait_until)
    monkeypatch.setattr(SimulatedCamera, "_publish", publish)
    report = source.run(6)
    assert starts == [0, 25_000_000, 50_000_000, 75_000_000, 80_000_000, 90_000_000]
    assert (report.frames, report.overruns, report.seconds) == (6, 4, 0.1)


def test_stop_before_the_first_frame(ring: PixelRing) -> None:
    stop = threading.Event()
    stop.set()
    report = small(ring).run(None, stop)
    assert (report.frames, report.overruns, report.frame_rate_hz) == (0, 0, 0.0)
    assert ring.progress() == (-1, 0)


def test_motion_has_its_spread_and_correlation() -> None:
    """AR(1) of 10 frames' correlation time: 48,000 values, about 4,800 independent ones.

    Standard deviation within 5 % (5 standard errors of 1 / sqrt(2 * 4800)); correlations within 0.05.
    """
    motion = SpotMotion(0.4, 0.01)
    positions = motion.positions(2000, 12, 1000.0, np.random.default_rng(1))
    assert positions.shape == (2000, 12, 2)
    assert positions.std() == pytest.approx(0.4, rel=0.05)
    assert positions[0].std() == pytest.approx(0.4, rel=0.5)
    for lag in (1, 10, 20):
        correlation = np.mean(positions[lag:] * positions[:-lag]) / positions.var()
        assert correlation == pytest.approx(np.exp(-lag / 10), abs=0.05)
    still = SpotMotion(0.0, 1.0).positions(3, 2, 100.0, np.random.default_rng(1))
    np.testing.assert_array_equal(still, 0.0)
    white = SpotMotion(1.0, 0.0).positions(5000, 2, 100.0, np.random.default_rng(1))
    assert abs(np.mean(white[1:] * white[:-1])) < 0.05


@pytest.mark.parametrize(
    ("bits", "dtype"), [(None, "float32"), (12, "uint16"), (16, "uint16"), (20, "uint32")]
)
def test_type_of_the_frames(name: str, bits: int | None, dtype: str) -> None:
    detector = Detector(1.0, offset_adu=100.0, bits=bits)
    assert readout_type(detector) == dtype
    with PixelRing.create(name, LAYOUT.frame_shape, readout_type(detector)) as ring:
        source = small(ring, detector=detector)
        assert source.frames.dtype == dtype
        source.run(1)
        np.testing.assert_array_equal(ring.slot(0), source.frames[0])


def test_bad_options(ring: PixelRing) -> None:
    good = partial(SimulatedCamera, ring=ring, layout=LAYOUT, frame_rate_hz=100.0, n_distinct=1)
    assert_each_refused(
        good,
        frame_rate_hz=[0, np.nan],
        readout_fraction=[1.1],
        rows_per_block=[0, 25],
        n_distinct=[0],
        flux_e=[-1.0],
        profile=["round"],
    )
    for options in ({"detector": Detector(1.0, bits=8)}, {"layout": Layout.grid((2, 2), pixels=8)}):
        with refused("ring: expected frames of"):
            good(**options)


def test_bad_motion_and_run(ring: PixelRing) -> None:
    for bad, which in (((-1.0, 0.1), "standard"), ((1.0, -0.1), "correlation"), ((np.nan, 0.1), "standard")):
        with pytest.raises(InputError, match=which):
            SpotMotion(*bad)
    with pytest.raises(InputError, match="n_frames = 0"):
        small(ring).run(0)


# ---- the command


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "faintspot.toml"
    path.write_text(CONFIGURATION)
    return path


def test_command(config: Path, name: str) -> None:
    assert isinstance(camera, click.Command)
    options = [
        "--config",
        str(config),
        *f"--name {name} --frame-rate-hz 400 --frames 20 --distinct 5".split(),
    ]
    result = CliRunner().invoke(camera, [*options, "--bits", "12", "--offset-adu", "50", "--seed", "1"])
    assert result.exit_code == 0, result.output
    first, last = result.output.splitlines()
    for text in (name, "24 x 32 pixels", "uint16", "12 sub-apertures", "400 frames/s"):
        assert text in first
    assert "20 frames, " in last
    assert "without a frame" in last
    assert not (FOLDER / name).exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_camera_is_the_one_that_the_configuration_describes(
    config: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the engine, which has the same file, would take a level of 0 for -100 ADU: no flux."""
    seen: list[Detector] = []

    def enough(*_: object, detector: Detector, **options: object) -> None:
        seen.append(detector)
        raise InputError("it is known")

    monkeypatch.setattr(camera_module, "SimulatedCamera", enough)
    Calibration(100.0, gain_e_per_adu=0.5, em_gain=20.0, read_noise_e=30.0).save(config)
    options = ["--config", str(config), "--name", name]
    for more in ([], ["--offset-adu", "0", "--gain-e-per-adu", "2", "--em-gain", "1", "--read-noise-e", "0"]):
        assert CliRunner().invoke(camera, [*options, *more]).exit_code == 1
    configured, given = seen
    assert (configured.offset_adu, configured.gain_e_per_adu) == (100.0, 0.5)
    assert (configured.em_gain, configured.read_noise_e) == (20.0, 30.0)
    assert (given.offset_adu, given.gain_e_per_adu, given.em_gain, given.read_noise_e) == (0, 2, 1, 0)


def test_command_refuses(config: Path, name: str) -> None:
    options = ["--config", str(config), "--name", name, "--frames", "1", "--distinct", "1"]
    for more, text in (
        (["--frame-rate-hz", "-5"], "frame_rate_hz = -5"),
        (["--name", "a/b"], "name = 'a/b'"),
    ):
        result = CliRunner().invoke(camera, [*options, *more])
        assert isinstance(result.exception, InputError)
        assert text in str(result.exception)
        assert not (FOLDER / name).exists()
    with PixelRing.create(name, (4, 4), np.float32):
        result = CliRunner().invoke(camera, options)
        assert isinstance(result.exception, InputError)
        assert "already writes into this pixel ring" in str(result.exception)
