"""Frames on which an estimator is tried before it measures real ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

_FLUX_E = 300.0
_NOISE_E = 3.0
_SPOT_STD_PX = 1.0
_SATURATED_ADU = 65535.0  # if the detector's saturation is not known


def trial_frames(pipeline: SlopePipeline) -> list[NDArray[np.float32]]:
    """Return frames (h, w) in ADU: without flux, with typical spots, of noise, of saturated pixels.

    The frames are the same each time.
    """
    calibration = pipeline.calibration
    dark, scale = _dark_and_scale(pipeline)
    noise = _NOISE_E * np.random.default_rng(1503).standard_normal(dark.shape)
    level = _SATURATED_ADU if calibration.saturation_adu is None else calibration.saturation_adu
    frames_adu = dark, dark + noise / scale, np.full_like(dark, level)
    return [typical_frame(pipeline), *(frame.astype(np.float32) for frame in frames_adu)]


def typical_frame(pipeline: SlopePipeline) -> NDArray[np.float32]:
    """Return a frame (h, w) in ADU with a spot in every sub-aperture and read noise; the same each time."""
    layout = pipeline.layout
    dark, scale = _dark_and_scale(pipeline)
    rng = np.random.default_rng(2015)
    ny, nx = layout.window
    rows, columns = np.arange(ny) - 0.5 * (ny - 1), np.arange(nx) - 0.5 * (nx - 1)
    spots = np.zeros(layout.frame_shape)
    for row, column in layout.corners:
        x, y = rng.uniform(-0.5, 0.5, 2)
        squared = (rows[:, None] - y) ** 2 + (columns - x) ** 2
        profile = np.exp(-0.5 * squared / _SPOT_STD_PX**2)
        spots[row : row + ny, column : column + nx] = _FLUX_E * profile / profile.sum()
    noise = _NOISE_E * rng.standard_normal(layout.frame_shape)
    frame: NDArray[np.float32] = (dark + (spots + noise) / scale).astype(np.float32)
    return frame


def _dark_and_scale(pipeline: SlopePipeline) -> NDArray[np.float32]:
    """Return dark (ADU) and electrons per ADU of every pixel, treating bad pixels like good ones."""
    maps = pipeline.calibration.maps(pipeline.layout.frame_shape)
    maps[0], maps[1] = np.nan_to_num(maps[0]), np.nan_to_num(maps[1], nan=1.0, posinf=1.0)
    return maps
