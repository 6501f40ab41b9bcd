"""Learning from a recording: its open-loop slopes are those that the loop had, and what is refused."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from tests.loop.control.control_cases import CELLS, FRAME_S, INTERACTION, telemetry
from tests.refusals import refused

from faintspot.cli.realtime import learn as realtime_learn
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.configuration import Control, load_control, save_control
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import open_loop_of
from faintspot.loop.control.integrator import CompiledIntegrator
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.telemetry.recording import recorded_loop, site_of
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.layout import Layout

GAIN = 0.8
OPTIONS = ControlOptions(gain=0.3, centroid_gain=GAIN)
CONTROL = Control(INTERACTION, None, OPTIONS)
LAYOUT = Layout.grid((3, 3), pixels=8)
OPEN_LOOP = telemetry(700, 0.3).open_loop_px


def recording(frames: int = 700) -> Any:
    """A closed loop on known open-loop slopes; frame 100 is lost, until frame 40 the loop is open."""
    line = CONTROL.line()
    integrator = CONTROL.controller(line)
    assert isinstance(integrator, CompiledIntegrator)
    slopes, sent = [], []
    for frame, open_loop in enumerate(OPEN_LOOP[:frames]):
        seen = open_loop + INTERACTION @ line.acting
        slopes.append(GAIN * seen)
        if frame < 40:
            line.put(line.latest)
        else:
            integrator.update(seen, np.ones(18))
        sent.append(line.latest.copy())
    kept = np.delete(np.arange(frames), 100)
    slopes_px = np.array(slopes, np.float32)[kept]
    error = np.full((len(kept), 9), 0.3 * GAIN, np.float32)
    return SimpleNamespace(
        attributes={"methods": ["set"]},
        frame=kept,
        loop=np.where(kept < 40, 1, 2),
        commands=np.array(sent, np.float32)[kept],
        slopes=slopes_px,
        valid=np.ones((len(kept), 9), bool),
        flags=np.tile(np.array([0] * 8 + [1], np.uint8), (len(kept), 1)),
        standard_error_x=error,
        standard_error_y=error,
        covariance_xy=-0.4 * error**2,
        last_row_time_ns=(kept * FRAME_S * 1e9).astype(np.int64),
    )


def open_loop(night: Any, control: Control, prior: np.ndarray | None = None) -> OpenLoopTelemetry:
    """Return the open-loop slopes for the configured centroid gain."""
    loop = recorded_loop(night, control, LAYOUT, prior)
    return open_loop_of(loop, LoopDelay(2.0, 0.0, 1.0, 0.0)).telemetry


def without_mean(first: int, lost: np.ndarray) -> np.ndarray:
    """Return the open-loop slopes from a frame on, 0 where lost, without the mean of the others."""
    slopes = np.where(lost, np.nan, OPEN_LOOP[first:])
    return np.asarray(np.nan_to_num(slopes - np.nanmean(slopes, axis=0)))


def test_open_loop_slopes_of_a_closed_loop() -> None:
    """Unknown in frame 100, which was lost, and in frame 102, in which its command would act."""
    night = recording()
    night.valid[300, 4] = False
    assert recorded_loop(night, CONTROL, LAYOUT).frame_rate_hz == pytest.approx(1 / FRAME_S, rel=1e-3)
    found = open_loop(night, CONTROL)
    first = 40 + 2  # the delay after the loop was closed
    lost = np.zeros((658, 18), bool)
    lost[301 - first, [4, 13]] = True
    lost[[100 - first, 102 - first]] = True
    np.testing.assert_allclose(found.open_loop_px, without_mean(first, lost), atol=1e-4)
    np.testing.assert_array_equal(np.isinf(found.variance_px2), lost)
    np.testing.assert_allclose(found.variance_px2[~lost], 0.09, rtol=1e-5)
    np.testing.assert_allclose(found.covariances_px2, np.where(lost[:, :9], 0.0, -0.036), rtol=1e-5)
    np.testing.assert_array_equal(found.trust, ~lost)


@pytest.mark.parametrize("prediction", ["none", "controller"])
def test_the_estimator_s_prior_is_taken_out(prediction: str) -> None:
    """Slopes were drawn half-way to what was expected: 0, or what the integrator expects."""
    night, prior = recording(), np.full(18, 0.3 * GAIN)
    control = Control(INTERACTION, None, OPTIONS.replaced({"prediction": prediction, "centroid_gain": 1.0}))
    sent = night.commands.astype(np.float64) @ INTERACTION.T
    expected = np.zeros((699, 18))
    if prediction == "controller":
        expected[2:] = sent[:-2] - sent[1:-1]
    night.slopes = (expected + 0.5 * (night.slopes / GAIN - expected)).astype(np.float32)
    for name in ("standard_error_x", "standard_error_y"):
        setattr(night, name, getattr(night, name) * np.float32(np.sqrt(0.5)))
    found = open_loop(night, control, prior)
    lost = np.zeros((658, 18), bool)
    lost[[100 - 42, 102 - 42]] = True
    np.testing.assert_allclose(found.open_loop_px, without_mean(42, lost), atol=1e-3)
    np.testing.assert_allclose(found.variance_px2[~lost], (0.3 * GAIN) ** 2, rtol=1e-4)
    np.testing.assert_allclose(found.trust[~lost], 0.5, rtol=1e-4)


def test_what_is_refused() -> None:
    prior, night = np.full(18, 0.3), recording()
    of_stream = Control(INTERACTION, None, OPTIONS.replaced({"prediction": "stream"}))
    with refused("integrator"):
        recorded_loop(night, of_stream, LAYOUT, prior)
    night.attributes["methods"] = ["window+integrator", "map+kalman"]
    with refused("integrator"):
        recorded_loop(night, CONTROL, LAYOUT, prior)
    infinite = np.full((699, 9), np.inf)
    for changes, *words in (
        ({"commands": np.zeros((699, 0))}, "12 commands", "got 0"),
        ({"loop": np.ones(699)}, "202 frames", "got 0"),
        ({"standard_error_x": infinite, "standard_error_y": infinite}, "read noise"),
    ):
        night = recording()
        vars(night).update(changes)
        with refused(*words):
            recorded_loop(night, CONTROL, LAYOUT)
    with refused("subaperture_m", "diameter_m"):
        site_of(LAYOUT)


def test_site_of_a_layout() -> None:
    layouts = (
        Layout.grid((3, 3), pixels=8, subaperture_m=0.6),
        Layout.grid((3, 3), pixels=8, diameter_m=1.8),
    )
    by_side, by_diameter = (site_of(each) for each in layouts)
    np.testing.assert_allclose(by_side.positions_m, CELLS[:, ::-1] * 0.6)
    np.testing.assert_allclose(by_diameter.positions_m, by_side.positions_m)
    # 500 nm, r0 of 0.15 m: the tilt without an outer scale (Noll), of which 25 m leave a part.
    tilt_arcsec2 = 0.17 * np.rad2deg(500e-9 / 0.6) ** 2 * 3600**2 * (0.6 / 0.15) ** (5 / 3)
    assert 0.3 < np.trace(by_side.covariance_px2()) / 18 / tilt_arcsec2 < 1.0


@pytest.mark.slow
def test_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "faintspot.toml"
    configuration_file.save(path, Layout.grid((3, 3), pixels=8, subaperture_m=0.6))
    configuration_file.save(path, Settings("brightest"))
    np.save(tmp_path / "m.npy", INTERACTION)

    def learn() -> Any:
        arguments = ["night.zarr", "--config", str(path)]
        return CliRunner().invoke(realtime_learn.learn, arguments, standalone_mode=False)

    assert "expected a table [control]" in str(learn().exception)
    save_control(path, interaction_matrix="m.npy", centroid_gain=GAIN)
    pytest.importorskip("zarr")
    monkeypatch.setattr("faintspot.io.read_telemetry", lambda *_, **__: recording())
    result = learn()
    assert result.exception is None, result.exception
    assert "658 frames at 250 a second: the filter leaves 0." in result.output
    assert "left out 1 of 9 sub-apertures: dark" in result.output
    control = load_control(path)
    assert control is not None
    assert (control.options.controller, control.prediction) == ("kalman", "controller")
