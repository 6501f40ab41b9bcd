"""faintspot telemetry of a running engine: it is recorded first, and the recording is kept where asked."""

import json
import secrets
from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import Commands

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("zarr")

from tests.engine import telemetry_cases
from tests.engine.telemetry_cases import FIELDS, LAYOUT, SETTINGS, Engine, N
from tests.experiments.night.recorded_cases import BEGIN_S, write_recording
from tests.io import loop_layouts
from tests.loop.telemetry.alternation_cases import (
    MATRIX,
    PIXEL_ARCSEC,
    RATE_HZ,
    SIDE,
    SUBAPERTURE_M,
    alternating,
)
from tests.loop.telemetry.loop_cases import recorded

from faintspot.engine.segment import FOLDER
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io import read_telemetry
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="needs POSIX shared memory as Linux has it")


def noisy(frame: int) -> Slopes:
    """Slopes of noise alone."""
    values = {name: np.zeros(N, kind) for name, kind in zip(FIELDS, RESULT_TYPES, strict=True)}
    noise = np.random.default_rng(frame).normal(0, 0.1, (2, N)).astype(np.float32)
    return Slopes(**{**values, "x": noise[0], "y": noise[1]})


@pytest.mark.slow
def test_running_engine_is_reported(folder: Path, run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(telemetry_cases, "slopes_of", noisy)
    name = f"faintspot-test-{secrets.token_hex(6)}"
    with Engine(TelemetryRing.create(name, LAYOUT, settings=SETTINGS)):
        told = run.ok("telemetry", "--engine", name, "--seconds", "1")
        assert told.out.endswith(f"{name}.html: open it in a browser; {name}.json has the numbers\n")
        assert "time is over" in told.err
        written = {each.name for each in folder.iterdir()}
        assert written == {"faintspot.toml", f"{name}.html", f"{name}.json"}
        assert json.loads(Path(f"{name}.json").read_text())
        run.ok("telemetry", "night.zarr", "--engine", name, "--seconds", "1", "-o", "page.html")
        assert len(read_telemetry("night.zarr").frame) > 0
        assert Path("page.html").exists()
        run.refused("telemetry", "night.zarr", "--engine", name, naming=("night.zarr", "exists"))
        run.refused("telemetry", "night.fits", "--engine", name, naming=("ends in .zarr",))
        run.refused("telemetry", "--engine", name, "-c", "absent.toml", naming=("absent.toml",))


def test_engine_without_frames(folder: Path, run: Commands) -> None:
    name = f"faintspot-test-{secrets.token_hex(6)}"
    ring = TelemetryRing.create(name, LAYOUT, settings=SETTINGS)
    told = run("telemetry", "--engine", name, "--seconds", "0.2")
    ring.close()
    assert told.code == 2
    assert f"{name}: no frames in 0.2 s" in told.err


def test_a_question_at_a_time(folder: Path, run: Commands) -> None:
    """Of a table each error names the option that answers it; the last ones are known from its file."""
    pytest.importorskip("astropy")
    loop = loop_layouts.random_loop()
    loop_layouts.sparta(folder, loop._replace(slopes=loop.slopes[:, :12], matrix=loop.matrix[:12]))
    given = ["telemetry", ".", "--output", "page.html"]
    run.refused(*given, "--slopes", "Slopes", naming=("--slopes", "Gradients"))
    run.refused(*given, "--slopes", "gradients", naming=("--slope-unit",))
    given += ["--slope-unit", "px"]
    run.refused(*given, naming=("--cells",))
    given += ["--cells", "none", "--slope-order", "rows"]
    run.refused(*given, naming=("slope_order", "pairs"))


def test_what_does_not_fit_together(folder: Path, run: Commands) -> None:
    run.refused("telemetry", naming=("expected FILE or --engine",))
    run.refused("telemetry", "night.zarr", "--seconds", "3", naming=("expected --engine",))
    run.refused("telemetry", "--engine", "nobody", naming=("start the engine first",))


@pytest.mark.slow
def test_controllers_that_cannot_be_learnt(folder: Path, run: Commands) -> None:
    """The report is there; the reason is one line."""
    loop = recorded()
    values = {"slopes": loop.slopes[:300], "commands": loop.commands[:300], "cells": loop.cells}
    known = {"interaction_matrix": loop.interaction_matrix, "frame_rate_hz": 250.0, "slope_unit": "px"}
    np.savez("loop.npz", **values, **known)
    told = run("telemetry", "loop.npz", "--controller", "controller.npz")
    assert told.code == 2
    reason = "keep the integrator: recording: expected 326 consecutive frames, got 300"
    assert f"controller.npz: not written, {reason}" in told.err
    assert Path("loop.html").exists()
    assert not Path("controller.npz").exists()
    np.savez("loop.npz", **values, **known, loop="open")
    run.refused("telemetry", "loop.npz", "--controller", "controller.npz", naming=("closed loop",))


@pytest.mark.slow
def test_methods_that_alternated_are_compared(folder: Path, run: Commands) -> None:
    known = alternating(2000)
    loop = known.loop
    layout = Layout.grid((SIDE, SIDE), pixels=8, pixel_scale_arcsec=PIXEL_ARCSEC, subaperture_m=SUBAPERTURE_M)
    write_recording(
        folder / "night.zarr", layout, loop.slopes_px, loop.commands, loop.method, ("none", "tv:0.6"), MATRIX
    )
    told = run.ok("telemetry", "night.zarr")
    assert "estimated from slopes" in told.out
    numbers = json.loads(Path("night.json").read_text())
    assert numbers["reference"] == "none"
    assert numbers["turns"] == 40
    assert "How the blocks were made" in Path("night.html").read_text()
    shown = BEGIN_S + np.arange(2000) / RATE_HZ
    np.savetxt("s.csv", np.stack([shown, 0.3 + 0.1 * loop.method], axis=1), delimiter=",", fmt="%.4f")
    Path("s.toml").write_text("science_wavelength_m = 2.2e-6\n")
    given = ("--settle", "9", "--strehl", "s.csv", "--system", "s.toml", "-o", "other.html")
    run.ok("telemetry", "night.zarr", *given)
    numbers = json.loads(Path("other.json").read_text())
    assert numbers["settle_frames"] == {"none": 9, "tv:0.6": 9}
    assert numbers["strehl"] == "measured"
    assert numbers["differences"][0]["without_r0"]["value"] == pytest.approx(0.1, abs=0.01)
    run.refused("telemetry", "night.zarr", "--strehl", "absent.csv", naming=("absent.csv",))
    run.refused("telemetry", "night.zarr", "--one-loop", "--settle", "5", naming=("--settle", "alternated"))
