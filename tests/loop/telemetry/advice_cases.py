"""Loops whose truth is known, made of numbers alone."""

from __future__ import annotations

from typing import Any

import numpy as np

import faintspot as fs
from faintspot.loop.telemetry.engine_telemetry import LoopTelemetry

LAYOUT = fs.Layout.grid((6, 6), pixels=8)
RATE_HZ = 200.0


def seen_with_truth(
    noise_px: float = 0.1,
    extra_px: float = 0.0,
    gain: float = 1.0,
    frames: int = 2400,
    segment: int = 60,
    vibration: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
) -> tuple[LoopTelemetry, np.ndarray]:
    """Return telemetry and the true residual slopes, px.

    The atmosphere is a sum of slow waves, the mirror follows it by two frames and adds a residual of
    `extra_px`; the slopes have noise and a centroid gain. The vibration along x has an amplitude in px and a
    frequency in Hz.
    """
    rng = np.random.default_rng(seed)
    m, time = 2 * len(LAYOUT), np.arange(frames) / RATE_HZ
    frequency = rng.uniform(0.2, 6.0, (12, m))
    phase = rng.uniform(0, 2 * np.pi, (12, m))
    atmosphere = np.sin(2 * np.pi * time[:, None, None] * frequency + phase).sum(axis=1) * 0.2
    amplitude, at = vibration
    atmosphere[:, : m // 2] += (amplitude * np.sin(2 * np.pi * at * time))[:, None]
    held = -np.vstack([np.zeros((2, m)), atmosphere[:-2]])
    held += extra_px * rng.standard_normal((frames, m))
    residual = atmosphere + held
    measured = gain * residual + noise_px * rng.standard_normal((frames, m))
    segments = np.arange(frames) // segment
    return LoopTelemetry(segments, measured, np.ones_like(measured), held, RATE_HZ), residual


def recording(
    seen: LoopTelemetry, commands: np.ndarray, delay: int, **changes: Any
) -> fs.io.telemetry.Telemetry:
    """Return a recording of slopes and of the commands that were computed from each frame."""
    from faintspot.io.telemetry.recording import Telemetry

    n, frames = len(LAYOUT), len(seen)
    each = np.zeros((frames, n), np.float32)
    when = (np.arange(frames) / RATE_HZ * 1e9).astype(np.int64)
    values: dict[str, Any] = {
        "frame": np.arange(frames),
        "method": np.zeros(frames, np.int64),
        "change": np.zeros(frames, np.int64),
        "last_row_time_ns": when,
        "published_time_ns": when + 1000,
        "clock_offset_ns": np.zeros(frames, np.int64),
        "x": seen.slopes_px[:, :n].astype(np.float32),
        "y": seen.slopes_px[:, n:].astype(np.float32),
        "flux": each,
        "standard_error_x": each + 0.1,
        "standard_error_y": each + 0.1,
        "covariance_xy": each,
        "iterations": each.astype(np.int32),
        "flags": each.astype(np.uint8),
        **{name: np.zeros(frames, np.int64) for name in ("late", "lost", "lost_because")},
        "loop": np.full(frames, 2),
        "commands": commands,
        "image_frame": np.zeros(0, np.int64),
        "raw": np.zeros((0, *LAYOUT.frame_shape), np.float32),
        "denoised": np.zeros((0, n, *LAYOUT.window), np.float32),
        "changes": [],
        "attributes": {"settings": "", "methods": ["set"]},
    }
    return Telemetry(**{**values, **changes})
