"""Estimate the turbulence from recorded telemetry of a simulated or real loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.ao_loop.pseudo_open_loop import pseudo_open_loop_slopes
from faintspot.base.checks import number_between
from faintspot.turbulence.seeing import Seeing, estimate_r0

Floats = NDArray[np.float64]

_FEWEST_FRAMES = 20


@dataclass(frozen=True, eq=False)
class TelemetryAnalysis:
    """Turbulence estimated from recorded telemetry of a loop."""

    slopes_px: Floats
    """(frames, 2 n): open-loop slopes."""
    seeing: Seeing
    """Turbulence estimated from all frames."""
    segments: tuple[Seeing, ...]
    """Turbulence of consecutive segments."""
    time_s: Floats
    """Time of the middle of each segment since the first frame."""


def analyse_telemetry(
    slopes_px: ArrayLike,
    commands: ArrayLike,
    interaction_matrix: ArrayLike,
    *,
    delay_frames: int,
    cells: ArrayLike,
    subaperture_m: float,
    pixel_scale_rad: float,
    outer_scale_m: float,
    frame_rate_hz: float,
    centroid_gain: ArrayLike = 1.0,
    segment_s: float = 10.0,
) -> TelemetryAnalysis:
    """Return open-loop slopes and r0, overall and in segments, from a loop's telemetry.

    Parameters
    ----------
    slopes_px, commands, interaction_matrix, delay_frames, centroid_gain
        As `pseudo_open_loop_slopes`; commands are those computed from each frame, unless the delay is 0.
    cells, subaperture_m, pixel_scale_rad, outer_scale_m
        As `estimate_r0`.
    frame_rate_hz : float
    segment_s : float
        Length of a segment; a remainder shorter than half of it is left out.

    Raises
    ------
    InputError
        When shapes do not fit together, or there are fewer than 20 frames.
    """
    slopes = pseudo_open_loop_slopes(
        slopes_px, commands, interaction_matrix, centroid_gain=centroid_gain, delay_frames=delay_frames
    )
    rate = number_between("frame_rate_hz", frame_rate_hz, 0, low_open=True)
    length = max(_FEWEST_FRAMES, round(number_between("segment_s", segment_s, 0, low_open=True) * rate))

    def seeing(part: Floats, static: Floats | None) -> Seeing:
        return estimate_r0(
            part,
            cells=cells,
            subaperture_m=subaperture_m,
            pixel_scale_rad=pixel_scale_rad,
            outer_scale_m=outer_scale_m,
            static_px=static,
        )

    whole = seeing(slopes, None)
    starts = range(0, max(1, len(slopes) - max(_FEWEST_FRAMES, length // 2) + 1), length)
    parts = [slopes[start : start + length] for start in starts]
    middles = [
        (delay_frames + start + len(part) / 2) / rate for start, part in zip(starts, parts, strict=True)
    ]
    segments = tuple(seeing(part, slopes.mean(axis=0)) for part in parts)
    return TelemetryAnalysis(slopes, whole, segments, np.array(middles))
