"""A small sensor with a calibration that is not trivial, and frames of it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.simulated import frames_of

import faintspot as fs
from faintspot.slopes.pipeline import configuration

LAYOUT = fs.Layout((30, 41), (8, 8), np.array([[2, 3], [2, 21], [12, 12], [22, 33]]))
OFF_CENTRE = fs.Layout(
    LAYOUT.frame_shape, LAYOUT.window, LAYOUT.corners, LAYOUT.corners[:, ::-1] + [[3.8, 3.3]]
)
"""Whose centres are not the windows' middles."""
_RNG = np.random.default_rng(2)
CALIBRATION = fs.Calibration(
    dark=_RNG.uniform(90.0, 110.0, LAYOUT.frame_shape),
    flat=_RNG.uniform(0.9, 1.1, LAYOUT.frame_shape),
    gain_e_per_adu=1.7,
    read_noise_e=1.0,
)


def frames(count: int) -> NDArray[np.float32]:
    """Return frames, ADU, of spots of 400 electrons that move."""
    rng = np.random.default_rng(3)
    electrons, _ = frames_of(
        LAYOUT, count, flux_e=400.0, positions=rng.uniform(-0.7, 0.7, (count, len(LAYOUT), 2)), rng=rng
    )
    dark, scale = CALIBRATION.maps(LAYOUT.frame_shape)
    return np.asarray(electrons / scale + dark, np.float32)


def other_weights(seed: int) -> fs.FixedWeights:
    """Return weights that are no centre of gravity."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, 8, 8))
    return fs.FixedWeights(x, y, np.full((8, 8), 1 / 64))


def written(folder: Path, settings: fs.Settings, layout: fs.Layout = LAYOUT, **others: Any) -> Path:
    """Return a configuration file."""
    path = folder / "faintspot.toml"
    for item in (layout, others.get("calibration", CALIBRATION), settings):
        configuration.save(path, item)
    return path
