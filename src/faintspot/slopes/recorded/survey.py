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
_FRAMES_APART = 8
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


def stretches(source: FrameSource) -> Iterator[NDArray[np.generic]]:
    """Yield up to 50 frames from each of 20 places all over a recording, in blocks (n, h, w); none twice.

    A damaged frame, which is reported when it is measured, ends them.
    """
    size = _block_frames(source)
    with suppress(InputError):
        for start, stop in _places(source):
            for _, block in source.blocks(start, stop, size):
                yield block


def frames_apart(source: FrameSource) -> Iterator[NDArray[np.generic]]:
    """Yield every eighth frame of the `stretches`, in blocks (n, h, w): the turbulence has moved on."""
    size = _block_frames(source)
    with suppress(InputError):
        for start, stop in _places(source):
            numbers = range(start, stop, _FRAMES_APART)
            for part in (numbers[first : first + size] for first in range(0, len(numbers), size)):
                yield np.concatenate([source.block(number, number + 1) for number in part])


def _places(source: FrameSource) -> list[tuple[int, int]]:
    """Return the first frame of each stretch, and the one after its last."""
    apart, end = max(source.n_frames / _LOOKS, _FRAMES), source.n_frames
    starts = (round(look * apart) for look in range(_LOOKS))
    return [(start, min(start + _FRAMES, end)) for start in starts if start < end]


def _block_frames(source: FrameSource) -> int:
    return max(1, _BLOCK_PIXELS // (source.shape[0] * source.shape[1]))


def survey(shape: tuple[int, ...], blocks: Iterable[NDArray[np.generic]]) -> Survey:
    """Look at frames of one shape, which come in blocks (n, h, w)."""
    frames, values, looked = MeanFrame(shape), LargestValues(), 0
    for block in blocks:
        frames.add(block)
        if looked < _FRAMES_FOR_SATURATION:
            values.add(block)
        looked += len(block)
    return Survey(frames.mean, values.saturation_adu)


class UsualFrames:
    """Selection of frames that are as bright as most, and not the same as the one before."""

    def __init__(self) -> None:
        self._kinds, self._repeated = [np.empty((0, 2))], [np.empty(0, bool)]
        self._last: NDArray[np.generic] | None = None

    def seen(self, block: NDArray[np.generic]) -> NDArray[np.generic]:
        """Look at the next frames (n, h, w), and return them."""
        self._kinds.append(_level_and_spread(block))
        self._repeated.append(are_repeated(block, self._last))
        self._last = block[-1]
        return block

    @property
    def repeated(self) -> NDArray[np.bool_]:
        """(n,): frames that are the same as the one before."""
        return np.concatenate(self._repeated)

    @property
    def unlike(self) -> NDArray[np.bool_]:
        """(n,): frames that are twice as bright as most, or half, or have another background."""
        level, spread = np.concatenate(self._kinds).T
        if len(level) < _FEWEST_TO_COMPARE:
            return np.zeros(len(level), bool)
        typical = float(np.median(spread))
        other_spread = (spread > _BRIGHTER * typical) | (spread < typical / _BRIGHTER)
        return np.asarray(other_spread | (np.abs(level - np.median(level)) > typical))


def _level_and_spread(frames: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return the median of each frame, and the rms of its pixels about it: (n, 2)."""
    kinds = []
    for frame in frames:
        pixels = frame[np.isfinite(frame)].astype(np.float64)
        level = float(np.median(pixels[:: 1 + pixels.size // _FOR_LEVEL])) if pixels.size else 0.0
        kinds.append((level, float(np.sqrt(np.mean(np.square(pixels - level)))) if pixels.size else 0.0))
    return np.array(kinds)
