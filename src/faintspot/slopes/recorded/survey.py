"""First look at recorded frames, all over the recording: their mean, and their saturation level."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.frames import FrameSource
from faintspot.slopes.camera.frame_checks import LargestValues
from faintspot.slopes.camera.mean_frame import MeanFrame, are_repeated

_LOOKS, _FRAMES = 20, 50  # stretches of frames over the whole recording
_FRAMES_FOR_SATURATION = 200
_BLOCK_PIXELS = 1 << 21  # in memory at a time
_FOR_LEVEL = 1 << 16  # pixels of a frame that show its median
_BRIGHTER, _FEWEST_TO_COMPARE = 2.0, 3  # factor of the rms from which a frame is unlike most; frames


@dataclass(frozen=True)
class Survey:
    """Mean of frames from all over a recording, and the level at which their values are clipped."""

    mean: NDArray[np.float64]
    """(h, w), ADU; NaN in pixels that are never finite."""
    saturation_adu: float | None
    """None if no values pile up."""
    usual: NDArray[np.bool_]
    """(n,): which frames are as bright as most, and not the same as the one before."""
    unlike: int
    """Number of frames that are twice as bright as most, or half, or have another background."""


def stretches(source: FrameSource) -> Iterator[NDArray[np.generic]]:
    """Yield up to 50 frames from each of 20 places all over a recording, in blocks (n, h, w); none twice.

    A damaged frame, which is reported when it is measured, ends them.
    """
    apart = max(source.n_frames / _LOOKS, _FRAMES)
    size = max(1, _BLOCK_PIXELS // (source.shape[0] * source.shape[1]))
    with suppress(InputError):
        for look in range(_LOOKS):
            start = round(look * apart)
            for _, block in source.blocks(start, min(start + _FRAMES, source.n_frames), size):
                yield block


def survey(shape: tuple[int, ...], blocks: Iterable[NDArray[np.generic]]) -> Survey:
    """Look at frames of one shape, which come in blocks (n, h, w)."""
    frames, values, looked = MeanFrame(shape), LargestValues(), 0
    kinds, repeated = [np.empty((0, 2))], [np.empty(0, bool)]
    last: NDArray[np.generic] | None = None
    for block in blocks:
        frames.add(block)
        if looked < _FRAMES_FOR_SATURATION:
            values.add(block)
        looked += len(block)
        kinds.append(_level_and_spread(block))
        repeated.append(are_repeated(block, last))
        last = block[-1]
    level, spread = np.concatenate(kinds).T
    unlike = np.zeros(looked, bool)
    if looked >= _FEWEST_TO_COMPARE:
        typical = float(np.median(spread))
        unlike = (spread > _BRIGHTER * typical) | (spread < typical / _BRIGHTER)
        unlike |= np.abs(level - np.median(level)) > typical
    usual = ~(unlike | np.concatenate(repeated))
    return Survey(frames.mean, values.saturation_adu, usual, int(np.count_nonzero(unlike)))


def _level_and_spread(frames: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return the median of each frame, and the rms of its pixels about it: (n, 2)."""
    kinds = []
    for frame in frames:
        pixels = frame[np.isfinite(frame)].astype(np.float64)
        level = float(np.median(pixels[:: 1 + pixels.size // _FOR_LEVEL])) if pixels.size else 0.0
        kinds.append((level, float(np.sqrt(np.mean(np.square(pixels - level)))) if pixels.size else 0.0))
    return np.array(kinds)
