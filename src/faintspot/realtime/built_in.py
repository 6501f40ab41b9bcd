"""Parts of a pipeline on their own: the same compiled code, with stages left out, on a frame or on images."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import LARGEST_FLOAT32
from faintspot.kernels import fused, located, thresholded
from faintspot.kernels.flat_start import NO_TABLE
from faintspot.kernels.parallel import new_scratch, new_spot_scratch
from faintspot.pipeline import SlopePipeline
from faintspot.sensor.layout import Layout
from faintspot.slopes import RESULT_TYPES, Slopes

# Places in the arguments of `SlopePipeline.kernel_call`.
_LANES, _FRAMES, _CORNERS, _, _, _CALIBRATION, _SATURATION, _TABLES, _, _BEFORE = range(10)

_IN_ROWS = 3  # more arguments come first where pixels are measured in rows


class BuiltIn:
    """Stages of a pipeline; memory is made beforehand and used again in every call.

    Parameters
    ----------
    pipeline : SlopePipeline
    on_images : bool
        Whether it takes calibrated images (n, ny, nx) float32, electrons, instead of frames.
    denoise, background : bool
        Whether these stages are done. Estimators that know the spot have neither.
    own_estimator : bool
        False: centres of gravity, whatever the pipeline's estimator.
    """

    def __init__(
        self,
        pipeline: SlopePipeline,
        *,
        on_images: bool,
        denoise: bool = True,
        background: bool = True,
        own_estimator: bool = True,
    ) -> None:
        layout = pipeline.layout
        self._function, self._rows, arguments, shape = _call(pipeline, denoise, background, own_estimator)
        self.gravity = self._function is not located.locate_groups
        self.denoises = self.gravity and arguments[_BEFORE] != fused.NOTHING
        self.settings: NDArray[np.float32] = arguments[_TABLES][0]
        """Rows as in `faintspot.kernels.fused`."""
        lanes = arguments[_LANES]
        self._groups = -(-len(layout) // lanes.width)
        self._frame_shape = layout.frame_shape
        if on_images:
            self._frame_shape = (len(layout) * layout.window[0], layout.window[1])
            arguments[_CORNERS] = _stacked_corners(layout)
            arguments[_CALIBRATION] = np.zeros_like(arguments[_CALIBRATION])
            arguments[_CALIBRATION][:, :, 1] = 1.0  # images - 0, times 1
            if self._rows:
                maps = np.repeat(np.array([0.0, 1.0], np.float32), math.prod(self._frame_shape))
                self._rows = (self._rows[0], maps.reshape(2, *self._frame_shape), self._rows[2])
        self._arguments = arguments
        if shape is None:
            self._scratch = new_scratch(lanes, *layout.window)
        else:
            self._scratch = new_spot_scratch(lanes, *layout.window, *shape)
        self._results = tuple(np.zeros((1, len(layout)), dtype) for dtype in RESULT_TYPES)
        self._stages = np.zeros((fused.STAGE_ROWS, 1, len(layout), layout.pixels), np.float32)
        self._images = self._stages.reshape(fused.STAGE_ROWS, len(layout), *layout.window)
        self.slopes = Slopes(*(result[0] for result in self._results))
        """Of the last call; overwritten by the next one, and free to be changed."""

    def __call__(self, images: NDArray[Any], saturation: float = float("nan")) -> NDArray[np.float32]:
        """Measure a frame or images; return the images after every step: (STAGE_ROWS, n, ny, nx)."""
        frames = np.ascontiguousarray(images).reshape(1, *self._frame_shape)
        if not frames.flags.writeable:  # for which all would be compiled once more
            frames = frames.copy()
        before = self._arguments[_CORNERS:_SATURATION]
        after = self._arguments[_SATURATION + 1 :]
        self._function(
            *self._rows,
            self._arguments[_LANES],
            frames,
            *before,
            saturation,
            *after,
            0,
            self._groups,
            self._scratch,
            self._results,
            self._stages,
        )
        return self._images


def _call(
    pipeline: SlopePipeline, denoise: bool, background: bool, own_estimator: bool
) -> tuple[Any, tuple[Any, ...], list[Any], tuple[int, int, int] | None]:
    """The compiled function, what it takes first to measure in rows, and its other arguments.

    Without the stages that are left out.
    """
    frames = np.zeros((1, *pipeline.layout.frame_shape), np.float32)
    function, given, shape = pipeline.kernel_call(frames, np.float32, np.zeros(1, np.int64))
    rows = given[:_IN_ROWS] if function is thresholded.thresholded_slopes else ()
    arguments = list(given[len(rows) :])
    if rows and background:
        return function, rows, arguments, shape
    if function is located.locate_groups:
        if own_estimator:
            return function, (), arguments, shape
        denoise = background = False
        no_taps = np.ones((len(pipeline.layout), 2, 1), np.float32)
        arguments[_BEFORE:] = [fused.NOTHING, 0, NO_TABLE, no_taps]
    if not denoise:
        arguments[_BEFORE] = fused.NOTHING
    if not background:
        tables = arguments[_TABLES].copy()
        tables[:, fused.RANK] = tables[:, fused.SUBTRACT] = 0.0
        tables[:, fused.LEVEL] = -LARGEST_FLOAT32  # below every pixel: all stay as they are
        arguments[_TABLES] = tables
    return fused.slopes_of_groups, (), arguments, None


def _stacked_corners(layout: Layout) -> NDArray[np.int64]:
    """Where each image is in a stack that is read as one frame."""
    corners = np.zeros((len(layout), 2), np.int64)
    corners[:, 0] = np.arange(len(layout)) * layout.window[0]
    corners.flags.writeable = False  # as a layout's: nothing is compiled for it alone
    return corners
