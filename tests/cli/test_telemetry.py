"""faintspot telemetry: questions, controllers, and methods that alternated."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import Commands

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("zarr")

from tests.experiments.night.recorded_cases import BEGIN_S, write_recording
from tests.loop.telemetry.alternation_cases import (
    MATRIX,
    PIXEL_ARCSEC,
    RATE_HZ,
    SIDE,
    SUBAPERTURE_M,
    alternating,
)
from tests.loop.telemetry.loop_cases import recorded

from faintspot.slopes.sensor.layout import Layout


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
        folder / "night.zarr", layout, loop.slopes, loop.commands, loop.method, ("none", "tv:0.6"), MATRIX
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
