"""First look at recorded frames, all over the recording: their mean, and their saturation level."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.io.frames import FrameSource
from faintspot.slopes.camera.saturation import LargestValues

_LOOKS, _FRAMES = 20, 50  # stretches of frames over the whole recording
_FRAMES_FOR_SATURATION = 200


@dataclass(frozen=True)
class Survey:
    """Mean of frames from all over a recording, and the level at which their values are clipped."""

    mean: NDArray[np.float64]
    """(h, w), ADU; NaN in pixels that are never finite."""
    saturation_adu: float | None
    """None if no values pile up."""


def stretches(source: FrameSource) -> Iterator[NDArray[np.generic]]:
    """Yield blocks of up to 50 frames (n, h, w) from 20 places all over a recording; no frame twice."""
    apart = max(source.n_frames / _LOOKS, _FRAMES)
    for look in range(_LOOKS):
        start = round(look * apart)
        if start < source.n_frames:
            yield source.block(start, min(start + _FRAMES, source.n_frames))


def survey(source: FrameSource) -> Survey:
    """Look at frames all over a recording, up to 1000 of them."""
    total, count = np.zeros(source.shape), np.zeros(source.shape, np.int64)
    values, looked = LargestValues(), 0
    for block in stretches(source):
        finite = np.isfinite(block)
        total += np.where(finite, block, 0).sum(axis=0, dtype=np.float64)
        count += finite.sum(axis=0)
        if looked < _FRAMES_FOR_SATURATION:
            values.add(block)
        looked += len(block)
    mean = np.divide(total, count, where=count > 0, out=np.full(source.shape, np.nan))
    return Survey(mean, values.saturation_adu)
