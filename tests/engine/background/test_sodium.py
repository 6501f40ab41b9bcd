"""Following a sodium layer beside an engine: its spots are handed over, and the engine measures with them."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.engine.bench import Bench
from tests.patience import wait_for

import faintspot as fs
from faintspot.base.errors import InputError
from faintspot.engine.background.sodium import SodiumFollower, background_sodium
from faintspot.engine.engine import Engine
from faintspot.engine.path.pipeline_maker import PipelineMaker
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.requests.private_socket import socket_path
from faintspot.engine.requests.requests import ControlServer
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.spots.laser_spots import LaserSpots

LAYOUT = fs.Layout.grid((5, 5), pixels=10, pixel_scale_arcsec=0.5, subaperture_m=1.6)
CALIBRATION = fs.Calibration(100.0, read_noise_e=1.0)
SETTINGS = fs.Settings("window", flux_e=300.0)
LASER = LaserSpots([-5.0, 0.0], 1.2)
STAR = LASER.star_of(LAYOUT)
FIRST, LATER = (
    STAR.focused(fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 3e3], shares))
    for shares in ([1, 0.001], [0.6, 0.4])
)
TABLE = """
[laser]
launch_m = [-5.0, 0.0]
spot_fwhm_arcsec = 1.2
matched_filter = true
follow_every_s = 1e-3
follow_time_constant_s = 0.05
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "faintspot.toml"
    for item in (LAYOUT, CALIBRATION, SETTINGS):
        item.save(path)
    path.write_text(path.read_text() + TABLE)
    return path


class Camera:
    """Telemetry of an engine whose every frame is kept; spots stay at their places."""

    def __init__(self, name: str) -> None:
        self.ring = TelemetryRing.create(name, LAYOUT)
        self._number = 0
        self._rng = np.random.default_rng(2)

    def images(self, profile: fs.SodiumProfile, count: int) -> None:
        rows, columns = LAYOUT.window_pixels
        for _ in range(count):
            frame = np.zeros(LAYOUT.frame_shape)
            frame[rows, columns] = 300.0 * STAR.images(profile, LAYOUT.window)
            noisy = self._rng.poisson(frame) + self._rng.normal(100.0, 1.0, frame.shape)
            arrays = [np.zeros(len(LAYOUT), kind) for kind in RESULT_TYPES]
            now = round(self._number * 1e6)
            self.ring.write(self._number, 0, 0, now, now, Slopes(*arrays))
            self.ring.write_images(self._number, noisy, np.zeros((len(LAYOUT), *LAYOUT.window)))
            self._number += 1


def taken(follower: SodiumFollower, camera: Camera, profile: fs.SodiumProfile, images: int) -> None:
    """Let images come as fast as the follower reads them."""
    for _ in range(images):
        camera.images(profile, 1)
        follower.take()


def test_a_layer_that_changes_is_handed_over(name: str, config: Path) -> None:
    camera, calls = Camera(name), list[dict[str, Any]]()

    def spots(fields: dict[str, Any]) -> dict[str, Any]:
        weights = fs.FixedWeights.load(fields["score"])
        calls.append({**fields, "weights": weights, "psf": fs.PSF.load(fields["psf"])})
        return {"frame": 7}

    with ControlServer(socket_path(name), {"spots": spots}, lengthy=("spots",)):
        follower = SodiumFollower(name, config)
        assert not follower.take()
        taken(follower, camera, FIRST, 60)
        assert follower.take()
        known = follower.fit()
        assert follower.is_new(known)
        assert follower.hand_over(known) == 7
        assert not follower.is_new(known)
        taken(follower, camera, LATER, 300)  # six time constants
        known = follower.fit()
        assert follower.is_new(known)
        follower.hand_over(known)
        follower.close()
    camera.ring.close()
    assert follower.ended
    # Two peaks: a fifth of the highest between them.
    altitude, flux = (np.array(calls[-1]["sodium"][key]) for key in ("altitude_km", "flux_per_km"))
    assert flux[np.abs(altitude - 90.6) < 1].min() < 0.2 * flux.max()
    assert calls[-1]["sodium"]["before_per_km"] != calls[-1]["sodium"]["flux_per_km"]
    # The weights know where the spots are: of the true spots to a hundredth of a pixel.
    spot = STAR.images(LATER, LAYOUT.window)
    weights = calls[-1]["weights"]
    assert np.abs((weights.x * (spot - weights.mean_spot)).sum(axis=(1, 2))).max() < 0.02


@pytest.mark.slow
def test_an_engine_measures_with_new_spots_from_the_next_frame(name: str, tmp_path: Path) -> None:
    """Slopes are those of a pipeline that has known them from the start."""
    pytest.importorskip("pyshmem")
    psf = STAR.psf(LATER)
    psf.save(tmp_path / "psf.npz")
    weights = fs.FixedWeights.matched(psf, LAYOUT.window, flux_e=300.0, read_noise_e=1.0)
    weights.save(tmp_path / "score.npz")
    known = {"altitude_km": [80.0, 90.0], "flux_per_km": [0.1, 0.1], "before_per_km": [0.1, 0.1]}
    fields = {"psf": f"{tmp_path}/psf.npz", "score": f"{tmp_path}/score.npz", "sodium": known}
    first = STAR.psf(FIRST)
    engine = Engine(name, PipelineMaker(LAYOUT, CALIBRATION, first), SETTINGS)
    take = commands_of(engine)["spots"]
    for wrong in ({**fields, "sodium": None}, {**fields, "psf": 3}, {**fields, "score": f"{tmp_path}/none"}):
        with pytest.raises(InputError):
            take(wrong)
    weights_of_others = fs.FixedWeights.matched(psf, (8, 8), flux_e=300.0, read_noise_e=1.0)
    weights_of_others.save(tmp_path / "others.npz")
    with pytest.raises(InputError):
        take({**fields, "score": f"{tmp_path}/others.npz"})
    assert engine.live.newest.pipelines[0].spot == (first, None)
    take(fields)
    pipeline = engine.live.newest.pipelines[0]
    frame = np.random.default_rng(3).normal(110.0, 5.0, LAYOUT.frame_shape).astype(np.float32)
    expected = fs.SlopePipeline(LAYOUT, SETTINGS, CALIBRATION, psf=psf, score=weights)
    np.testing.assert_array_equal(pipeline(frame).vector, expected(frame).vector)
    assert engine.status()["sodium"]["flux_per_km"] == [0.1, 0.1]
    engine._streams.close()
    engine._telemetry.close()


def test_an_engine_of_other_pipelines_refuses(bench: Bench, tmp_path: Path) -> None:
    STAR.psf(FIRST).save(tmp_path / "psf.npz")
    with pytest.raises(InputError, match="pipelines"):
        commands_of(bench.engine)["spots"]({"psf": f"{tmp_path}/psf.npz", "sodium": {}})


def test_a_laser_that_is_not_followed_is_refused(name: str, config: Path) -> None:
    config.write_text(config.read_text().replace("follow_every_s = 1e-3", ""))
    with pytest.raises(InputError, match="follow_every_s"):
        SodiumFollower(name, config)


@pytest.mark.machine_time("other processes")
def test_a_process_that_dies_is_one_line(name: str, tmp_path: Path) -> None:
    engine, lines = SimpleNamespace(name=name, sodium=None), list[str]()
    with background_sodium(engine, tmp_path / "none.toml", lines.append):  # type: ignore[arg-type]
        wait_for(lambda: bool(lines))
    assert len(lines) == 1
    assert "none.toml" in engine.sodium["fault"]
