"""Parts of a pipeline on their own: the same compiled code, with stages left out, on a frame or on images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.estimators.centroid import CentreOfGravity
from faintspot.estimators.gravity import GravityPrepared
from faintspot.kernels import gravity
from faintspot.kernels.compiling import Direct
from faintspot.kernels.groups import STAGE_ROWS, SlopeArrays, new_scratch
from faintspot.kernels.host import lanes_for
from faintspot.pipeline import SlopePipeline
from faintspot.slopes import RESULT_TYPES, Slopes


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
        if not own_estimator and not isinstance(pipeline.preparation.prepared, GravityPrepared):
            pipeline = pipeline.with_settings(pipeline.settings.replace(estimator=CentreOfGravity()))
            denoise = background = False
        if on_images:
            pipeline = pipeline.for_images()
        prepared = pipeline.preparation.prepared
        task = pipeline.preparation.task(np.zeros(1, np.int64))
        self.gravity = isinstance(prepared, GravityPrepared)
        self.denoises = False
        kernel = prepared.kernel
        if isinstance(prepared, GravityPrepared):
            self.denoises = denoise and prepared.before != gravity.NOTHING
            kernel, task = prepared.part(task, denoise=denoise, background=background)
        # Trials and images come as float32, a camera's frames perhaps as uint16.
        self._kernels = {kind: Direct(kernel) for kind in ("uint16", "float32")}
        self._task, self._pipeline = task, pipeline
        self.settings: NDArray[np.float32] = task.settings[0]
        """Rows as in `faintspot.kernels.groups`, and those of the estimator's kernel."""
        layout, lanes = pipeline.layout, lanes_for(np.float32, pipeline.width)
        self._groups = -(-len(layout) // lanes.width)
        own_scratch = pipeline.preparation.own_scratch
        self._scratch = new_scratch(lanes, *layout.window, own_scratch(lanes, *layout.window))
        self._results = SlopeArrays(*(np.zeros((1, len(layout)), dtype) for dtype in RESULT_TYPES))
        self._stages = np.zeros((STAGE_ROWS, 1, len(layout), layout.pixels), np.float32)
        self._images = self._stages.reshape(STAGE_ROWS, len(layout), *layout.window)
        self.slopes = Slopes(*(result[0] for result in self._results))
        """Of the last call; overwritten by the next one, and free to be changed."""

    def __call__(self, images: NDArray[Any], saturation: float = float("nan")) -> NDArray[np.float32]:
        """Measure a frame or images; return the images after every step: (STAGE_ROWS, n, ny, nx)."""
        frames = np.ascontiguousarray(images).reshape(1, *self._pipeline.layout.frame_shape)
        source = self._pipeline.source(frames, frames.dtype)._replace(saturation=saturation)
        kernel = self._kernels[frames.dtype.name]
        kernel(source, self._task, 0, self._groups, self._scratch, self._results, self._stages)
        return self._images
