"""First look at recorded frames: configuration, mean, saturation level, and response of the slopes."""

import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError, errors_within
from faintspot.io.fits_units import is_aot
from faintspot.io.frames import FrameSource
from faintspot.io.stored_array import split_location
from faintspot.slopes.camera.frame_checks import LargestValues, MeanFrame, are_repeated
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout

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


def configured(
    path: str | Path, frames: Sequence[str | Path], key: str | None
) -> tuple[Configuration, str, NDArray[Any] | None]:
    """Return the configuration, what of it is that of an AOT file, in words, and that file's references."""
    described = Configuration(path) if Path(path).exists() else None
    first = None if described is not None and "layout" in described else _aot_file(frames)
    if first is None:
        return described or Configuration(path), "", None
    from faintspot.io.aot_reading import read_aot  # only for such files

    sensor = read_aot(first[0], first[1] or key)
    where = f"{first[0]}: sensor {sensor.name!r}"
    if sensor.layout is None:
        raise InputError(
            f"{where}: expected its sub-apertures (subaperture_mask, mask_offsets, subaperture_size), found "
            f"none; give [layout] in {path}"
        )
    with errors_within(where):
        layout = Layout(**sensor.layout)
    if described is None:
        command = _layout_command(frames[0], layout, path)
        raise InputError(f"{path}: no such file; `{command}` makes one with settings for {first[0]}")
    words = "sub-apertures" if sensor.reference is None else "sub-apertures, reference slopes"
    return Configuration(path, described.tables, layout=layout), f"{words} of {first[0]}", sensor.reference


def _aot_file(frames: Sequence[str | Path]) -> tuple[Path, str | None] | None:
    """Return the first file of frames and the key in its name, if it is one of telemetry (AOT)."""
    if isinstance(frames, str | Path) or not frames:
        return None
    try:
        first = split_location(frames[0])
    except InputError:  # whoever opens it says so, after what is wrong with the configuration
        return None
    return first if is_aot(first[0]) else None


def _layout_command(frames: str | Path, layout: Layout, path: str | Path) -> str:
    """Return the command that writes a configuration for a layout whose cells are on a grid."""
    rows, columns = np.ptp(layout.cells, axis=0) + 1
    (top, left), (bottom, right) = layout.corners.min(axis=0), layout.corners.max(axis=0) + layout.window
    is_whole = (top, left, bottom, right) == (0, 0, *layout.frame_shape)
    roi = [] if is_whole else ["--roi", f"{left},{top},{right},{bottom}"]
    words = ["faintspot", "layout", str(frames), "--grid", f"{rows}x{columns}", *roi, "-o", str(path)]
    return shlex.join(words)


_STEP_PX = 0.25


def response(pipeline: SlopePipeline, mean_frame: Floats, frames: Iterable[NDArray[Any]]) -> Floats:
    """Return the slopes shown for a displacement of 1 px, (2 n,), all x, then all y.

    Slopes with fixed weights are linear in the pixels: their mean change, when all spots are displaced, is
    the change for the displaced mean of the frames. Others are measured in single frames displaced by whole
    pixels, which leave the noise unchanged. The mean change over Gaussian displacements is the regression of
    the slopes on them, whatever the estimator does with spots that are faint or at the edges of windows.

    Parameters
    ----------
    pipeline : SlopePipeline
    mean_frame : (h, w) array
        Mean of the frames, ADU.
    frames : iterable of (n, h, w) array, ADU
        Blocks of frames from all over the recording, as from `frames_apart`.
    """
    dark = np.nan_to_num(pipeline.calibration.maps(mean_frame.shape)[0])
    if pipeline.settings.estimator.name == "window":
        mean = np.where(np.isnan(mean_frame), np.nanmedian(mean_frame), mean_frame)
        changes = [_change(pipeline, mean[None], dark, _STEP_PX)]
    else:
        changes = [_change(pipeline, block, dark, 1.0) for block in frames]
    return np.asarray(np.concatenate(changes, axis=1).mean(axis=1))


def _change(pipeline: SlopePipeline, frames: NDArray[Any], dark: Floats, step_px: float) -> Floats:
    """Return the change of slopes (2 n, frames) per px, of frames displaced along x and along y."""
    order, light = (0 if step_px == 1 else 3), frames - dark
    changes = []
    for axis, direction in (("x", (0, 0, step_px)), ("y", (0, step_px, 0))):
        ahead, behind = (
            dark + scipy.ndimage.shift(light, sign * np.array(direction), order=order, mode="nearest")
            for sign in (1, -1)
        )
        ahead, behind = (getattr(pipeline(each.astype(np.float32)), axis) for each in (ahead, behind))
        changes.append((ahead.astype(np.float64) - behind) / (2 * step_px))
    return np.hstack(changes).T
