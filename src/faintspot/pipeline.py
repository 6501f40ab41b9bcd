"""The slope pipeline: frame -> calibrate -> denoise -> background -> centroid -> slopes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array, number_between, real_array
from faintspot.errors import InputError
from faintspot.estimate.brightest import most_kept, threshold_rank
from faintspot.estimate.total_variation import ALGORITHMS
from faintspot.flags import INVALID
from faintspot.kernels import fused
from faintspot.kernels.host import lanes_for
from faintspot.kernels.parallel import run_groups
from faintspot.sensor import configuration
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.sensor.settings import Settings


@dataclass(frozen=True)
class Slopes:
    """Slopes of one frame, arrays of shape (n_subapertures,), or of several, (n_frames, n_subapertures)."""

    x: NDArray[np.float32]
    """Position of the spot along columns, px from the reference; 0 where invalid."""
    y: NDArray[np.float32]
    """Position along rows."""
    flux: NDArray[np.float32]
    """Electrons left after the background subtraction."""
    flags: NDArray[np.uint8]
    """Bits of `SubapertureFlag`."""
    iterations: NDArray[np.int32]
    """Iterations that the denoising took."""
    bad_pixels: NDArray[np.int32]
    """Number of pixels that were masked, NaN or infinite."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether the slope was measured."""
        return (self.flags & INVALID) == 0  # type: ignore[no-any-return]

    @property
    def vector(self) -> NDArray[np.float32]:
        """All x, then all y, along the last axis: what a reconstructor multiplies."""
        return np.concatenate([self.x, self.y], axis=-1)


@dataclass(frozen=True)
class Stages:
    """The sub-aperture images after every step, (..., n_subapertures, ny, nx), and the slopes."""

    raw: NDArray[Any]
    """As in the frame, ADU."""
    calibrated: NDArray[np.float32]
    """Electrons, bad pixels filled."""
    denoised: NDArray[np.float32]
    background_subtracted: NDArray[np.float32]
    slopes: Slopes


class SlopePipeline:
    """Turns frames into slopes.

    Parameters
    ----------
    layout : Layout
    settings : Settings
    calibration : Calibration, optional
        Default: frames are in electrons already.
    reference : array or Slopes, optional
        Reference positions, px from each sub-aperture's centre, subtracted from every position: (n, 2) x and
        y, or (2 n,) all x then all y, or the slopes of one frame. Default 0.
    width : int, optional
        SIMD width in float32 numbers: 4, 8 or 16. Default: what the machine has.
    threads : int, optional
        Most threads to use. Default: all processors that the process may use. Slopes do not depend on it.

    Raises
    ------
    InputError
        When the parts do not fit together.

    Examples
    --------
    >>> import faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    >>> pipeline = fs.SlopePipeline(layout, fs.Settings(noise_std=0.5, keep_brightest=12))
    >>> slopes = pipeline(frame)  # doctest: +SKIP
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        calibration: Calibration | None = None,
        reference: ArrayLike | Slopes | None = None,
        *,
        width: int | None = None,
        threads: int | None = None,
    ) -> None:
        self.layout = layout
        self.settings = settings
        self.calibration = Calibration() if calibration is None else calibration
        self.threads = (
            None if threads is None else int(number_between("threads", threads, 1, 4096, integer=True))
        )
        self._lanes = lanes_for(np.float32, width)
        self._calibration = _packed_calibration(layout, self.calibration, self._lanes.width)
        self._table = _settings_table(layout, settings)
        zero = layout.offsets + _reference_positions(reference, len(layout))
        self._table[fused.ZERO_X], self._table[fused.ZERO_Y] = zero.T

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> SlopePipeline:
        """Make the pipeline that a configuration file (faintspot.toml) describes."""
        layout, settings, calibration = configuration.load_all(path)
        return cls(layout, settings, calibration, **options)

    def fingerprint(self) -> bytes:
        """Return bytes that differ between pipelines that could give different slopes for the same frame."""
        parts = (self.layout.corners, self.calibration.maps(self.layout.frame_shape), self._table)
        text = f"{self.layout.window} {self.settings.algorithm} {self.calibration.saturation_adu}"
        return b"".join(np.ascontiguousarray(part).tobytes() for part in parts) + text.encode()

    def __call__(self, frame: ArrayLike) -> Slopes:
        """Measure the slopes of a frame (h, w) or of frames (n, h, w), in ADU.

        NaN and infinite pixels count as bad pixels; a sub-aperture that cannot be measured is flagged.

        Raises
        ------
        InputError
            For a frame that is not real or not of the layout's shape.
        """
        return self._run(self._checked(frame), explain=False)[0]

    def explain(self, frame: ArrayLike) -> Stages:
        """Return the sub-aperture images after every step, for pictures and for finding faults."""
        array = self._checked(frame)
        slopes, stages = self._run(array, explain=True)
        calibrated, denoised, background = stages.reshape(3, *slopes.x.shape, *self.layout.window)
        return Stages(self.layout.images(array), calibrated, denoised, background, slopes)

    def _checked(self, frame: ArrayLike) -> NDArray[Any]:
        array = real_array("frame", frame, minimum_dimensions=2)
        if array.ndim > 3 or array.shape[-2:] != self.layout.frame_shape:
            height, width = self.layout.frame_shape
            raise InputError(
                f"frame: expected shape ({height}, {width}) or (n, {height}, {width}), got {array.shape}"
            )
        return array

    def _run(self, array: NDArray[Any], explain: bool) -> tuple[Slopes, NDArray[np.float32]]:
        """Compute the slopes, and the stages where asked for."""
        frames = _kernel_frames(array)
        n_frames, n = len(frames), len(self.layout)
        dtypes = (np.float32, np.float32, np.float32, np.uint8, np.int32, np.int32)
        results = tuple(np.empty((n_frames, n), dtype) for dtype in dtypes)
        stages = np.empty((fused.STAGE_ROWS if explain else 0, n_frames, n, self.layout.pixels), np.float32)
        saturation = self.calibration.saturation(array.dtype)
        algorithm = ALGORITHMS[self.settings.algorithm]

        def job(start: int, stop: int, scratch: tuple[Any, ...]) -> None:
            fused.slopes_of_groups(
                self._lanes,
                frames,
                self.layout.corners,
                *self.layout.window,
                self._calibration,
                saturation,
                self._table,
                algorithm,
                start,
                stop,
                scratch,
                results,
                stages,
            )

        n_groups = n_frames * -(-n // self._lanes.width)
        run_groups(job, n_groups, self._lanes, self.layout.window, self.threads)
        shaped: Any = (result.reshape(*array.shape[:-2], n) for result in results)
        return Slopes(*shaped), stages


def _kernel_frames(array: NDArray[Any]) -> NDArray[Any]:
    """The frames as the kernel reads them: (n, h, w), contiguous, uint16 or float32."""
    dtype = np.uint16 if array.dtype in (np.uint8, np.uint16) else np.float32
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite: a bad pixel
        frames = np.ascontiguousarray(array, dtype=dtype)
    return frames.reshape(-1, *array.shape[-2:])


def _packed_calibration(layout: Layout, calibration: Calibration, width: int) -> NDArray[np.float32]:
    """Dark and scale of every sub-aperture's pixels in the kernel's own order, to be read as one stream.

    Shape (n_groups, pixels, 2, W); the last group repeats its last sub-aperture.
    """
    n_groups = -(-len(layout) // width)
    windows = layout.images(calibration.maps(layout.frame_shape)).reshape(2, len(layout), layout.pixels)
    lanes = windows[:, np.minimum(np.arange(n_groups * width), len(layout) - 1)]
    return np.ascontiguousarray(lanes.reshape(2, n_groups, width, layout.pixels).transpose(1, 3, 0, 2))


def _settings_table(layout: Layout, settings: Settings) -> NDArray[np.float32]:
    """Settings of every sub-aperture as the kernel reads them."""
    n, pixels = len(layout), layout.pixels

    def each(name: str) -> NDArray[Any]:
        return settings.values(name, n, pixels)

    table = np.zeros((fused.SETTING_ROWS, n), np.float32)
    table[fused.STRENGTH] = np.where(each("denoise"), each("noise_std"), 0.0)
    table[fused.TOLERANCE] = each("tolerance")
    table[fused.LIMIT] = each("max_iterations")
    table[fused.FLOOR] = each("flux_floor")
    table[fused.MOST_BAD] = np.floor(each("max_bad_fraction") * pixels)
    keep, rules = each("keep_brightest"), each("rule")
    for rule in np.unique(rules):
        selected = rules == rule
        limit = most_kept(pixels, rule)
        if keep[selected].max() > limit:
            raise InputError(
                f"settings.keep_brightest = {keep[selected].max()}: expected at most {limit} "
                f"with rule {str(rule)!r} in windows of {layout.window[0]} x {layout.window[1]} pixels"
            )
        table[fused.RANK, selected] = threshold_rank(keep[selected], rule)
        table[fused.SUBTRACT, selected] = rule != "threshold"
    return table


def _reference_positions(reference: ArrayLike | Slopes | None, n: int) -> NDArray[np.float64]:
    """Reference positions as (n, 2)."""
    if reference is None:
        return np.zeros((n, 2))
    array = finite_array("reference", reference.vector if isinstance(reference, Slopes) else reference)
    if array.shape == (2 * n,):
        return np.stack([array[:n], array[n:]], axis=1).astype(np.float64)
    if array.shape != (n, 2):
        raise InputError(f"reference: expected shape ({n}, 2) or ({2 * n},), got {array.shape}")
    return array.astype(np.float64)
