"""First look at recorded frames, all over the recording: their mean, and their saturation level."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.frames import FrameSource
from faintspot.slopes.camera.mean_frame import MeanFrame
from faintspot.slopes.camera.saturation import LargestValues

_LOOKS, _FRAMES = 20, 50  # stretches of frames over the whole recording
_FRAMES_FOR_SATURATION = 200
_BLOCK_PIXELS = 1 << 21  # in memory at a time


@dataclass(frozen=True)
class Survey:
    """Mean of frames from all over a recording, and the level at which their values are clipped."""

    mean: NDArray[np.float64]
    """(h, w), ADU; NaN in pixels that are never finite."""
    saturation_adu: float | None
    """None if no values pile up."""


def stretches(source: FrameSource) -> Iterator[NDArray[np.generic]]:
    """Yield up to 50 frames from each of 20 places all over a recording, in blocks (n, h, w); none twice."""
    apart = max(source.n_frames / _LOOKS, _FRAMES)
    size = max(1, _BLOCK_PIXELS // (source.shape[0] * source.shape[1]))
    for look in range(_LOOKS):
        start = round(look * apart)
        for _, block in source.blocks(start, min(start + _FRAMES, source.n_frames), size):
            yield block


def survey(source: FrameSource) -> Survey:
    """Look at frames all over a recording, up to 1000 of them."""
    frames, values, looked = MeanFrame(source.shape), LargestValues(), 0
    with suppress(InputError):  # of a damaged frame, which is reported when it is measured
        for block in stretches(source):
            frames.add(block)
            if looked < _FRAMES_FOR_SATURATION:
                values.add(block)
            looked += len(block)
    return Survey(frames.mean, values.saturation_adu)
