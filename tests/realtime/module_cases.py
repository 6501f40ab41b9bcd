"""Modules for tests, and the sensor that they are tried on."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent, indent
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.realtime.module_loading import Module, load_module

GRID = fs.Layout.grid((5, 4), pixels=8, pitch=(9, 8))
LAYOUT = fs.Layout(GRID.frame_shape, GRID.window, GRID.corners, GRID.centres + np.array([0.25, -0.5]))
CALIBRATION = fs.Calibration(100.0, gain_e_per_adu=0.5, read_noise_e=1.0, bad_pixels=[[3, 3], [12, 20]])
SETTINGS = fs.Settings(noise_std=1.0, keep_brightest=9, search_range_px=1.5)


def pipeline(settings: fs.Settings = SETTINGS) -> fs.SlopePipeline:
    reference = np.random.default_rng(3).uniform(-0.2, 0.2, (len(LAYOUT), 2))
    return fs.SlopePipeline(LAYOUT, settings, CALIBRATION, reference, psf=fs.PSF.analytic())


def frames(n: int) -> NDArray[np.uint16]:
    """Frames with everything that is flagged: saturated, dark and mostly bad sub-apertures."""
    detector = fs.simulate.Detector(1.0, gain_e_per_adu=0.5, offset_adu=100.0, bits=16)
    simulated, _ = fs.simulate.sensor_frames(
        LAYOUT.corners,
        LAYOUT.window,
        LAYOUT.frame_shape,
        n,
        flux_e=200.0,
        detector=detector,
        rng=np.random.default_rng(4),
    )
    data = np.asarray(simulated, np.uint16)
    data[0, 20, 3] = 65535
    data[:, 9:17, 8:16] = 100
    return data


def write(folder: Path, stage: str, body: str, name: str = "module") -> Path:
    """Write a module whose function has this body; `images` is what it is given."""
    path = folder / f"{name}.py"
    function = f"def function(images):\n{indent(dedent(body), '    ')}"
    text = f"""
import time
import numpy as np
import faintspot as fs
STAGE = {stage!r}
def make(layout, settings):
{indent(function, "    ")}
    return function
"""
    path.write_text(text)
    return path


def module(folder: Path, stage: str, body: str, name: str = "module") -> dict[str, Module]:
    """A module as a ModularPipeline takes it."""
    loaded = load_module(write(folder, stage, body, name))
    return {loaded.stage: loaded}


def assert_same(found: fs.Slopes, expected: fs.Slopes, *, but: tuple[str, ...] = ()) -> None:
    values: dict[str, Any] = vars(expected)
    for name in values.keys() - set(but):
        assert np.array_equal(getattr(found, name), values[name]), name
