"""Loops whose truth is known, made of numbers alone."""

from __future__ import annotations

from typing import Any

import numpy as np

import faintspot as fs
from faintspot.advice.loop_telemetry import LoopTelemetry

LAYOUT = fs.Layout.grid((6, 6), pixels=8)
RATE_HZ = 200.0


def seen_with_truth(
    noise_px: tuple[float, float] = (0.1, 0.1),
    extra_px: tuple[float, float] = (0.0, 0.0),
    gains: tuple[float, float] = (1.0, 1.0),
    frames: int = 2400,
    turn: int = 60,
    vibration: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
) -> tuple[LoopTelemetry, np.ndarray]:
    """Return two arms in turn and the true residual slopes, px.

    The air is a sum of slow waves, the mirror follows it by two frames; arm a has the noise `noise_px[a]`, a
    residual of `extra_px[a]` beside, which its mirror makes, and shows `gains[a]` of what there is. The
    vibration has an amplitude in px and a frequency in Hz, along x.
    """
    rng = np.random.default_rng(seed)
    m, time = 2 * len(LAYOUT), np.arange(frames) / RATE_HZ
    frequency = rng.uniform(0.2, 6.0, (12, m))
    phase = rng.uniform(0, 2 * np.pi, (12, m))
    atmosphere = np.sin(2 * np.pi * time[:, None, None] * frequency + phase).sum(axis=1) * 0.2
    amplitude, at = vibration
    atmosphere[:, : m // 2] += (amplitude * np.sin(2 * np.pi * at * time))[:, None]
    arm = np.arange(frames) // turn % 2
    held = -np.vstack([np.zeros((2, m)), atmosphere[:-2]])
    held += np.array(extra_px)[arm][:, None] * rng.standard_normal((frames, m))
    residual = atmosphere + held
    noise = np.array(noise_px)[arm][:, None]
    measured = np.array(gains)[arm][:, None] * residual + noise * rng.standard_normal((frames, m))
    variance = np.broadcast_to(noise**2, measured.shape)
    seen = LoopTelemetry(
        arm, np.arange(frames) // turn, measured, variance, np.ones_like(measured), held, RATE_HZ
    )
    return seen, residual


def recording(
    seen: LoopTelemetry, commands: np.ndarray, delay: int, **changes: Any
) -> fs.io.telemetry.Telemetry:
    """Return a recording of slopes and of the commands that were computed from each frame."""
    from faintspot.io.telemetry import Telemetry

    n, frames = len(LAYOUT), len(seen)
    each = np.zeros((frames, n), np.float32)
    when = (np.arange(frames) / RATE_HZ * 1e9).astype(np.int64)
    values: dict[str, Any] = {
        "frame": np.arange(frames),
        "arm": seen.arm,
        "change": np.zeros(frames, np.int64),
        "last_row_time_ns": when,
        "published_time_ns": when + 1000,
        "clock_offset_ns": np.zeros(frames, np.int64),
        "x": seen.slopes_px[:, :n].astype(np.float32),
        "y": seen.slopes_px[:, n:].astype(np.float32),
        "flux": each,
        "standard_error_x": each + 0.1,
        "standard_error_y": each + 0.1,
        "iterations": each.astype(np.int32),
        "flags": each.astype(np.uint8),
        "loop": np.full(frames, 2),
        "commands": commands,
        "image_frame": np.zeros(0, np.int64),
        "raw": np.zeros((0, *LAYOUT.frame_shape), np.float32),
        "denoised": np.zeros((0, n, *LAYOUT.window), np.float32),
        "changes": [],
        "attributes": {"settings": "", "arms": ["set"]},
    }
    return Telemetry(**{**values, **changes})
