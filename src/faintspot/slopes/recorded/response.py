"""Response of linear slopes to a displacement of the spots, from the mean of the frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

Floats = NDArray[np.float64]

_STEP_PX = 0.25


def response(pipeline: SlopePipeline, mean_frame: Floats) -> Floats | None:
    """Return the slopes shown for a displacement of 1 px, (2 n,), all x, then all y; None if not linear.

    Slopes with fixed weights are linear in the pixels: their mean change, when all spots are displaced, is
    the change for the displaced mean of the frames. It holds for speckled spots that move far, at any flux.

    Parameters
    ----------
    pipeline : SlopePipeline
    mean_frame : (h, w) array
        Mean of the frames, ADU.
    """
    if not isinstance(pipeline.settings.estimator, Window):
        return None
    mean = np.where(np.isnan(mean_frame), np.nanmedian(mean_frame), mean_frame)
    shifts = _STEP_PX * np.array([[0, 1], [0, -1], [1, 0], [-1, 0]])
    moved = np.array([ndimage.shift(mean, shift, order=3, mode="nearest") for shift in shifts])
    slopes = pipeline(moved.astype(np.float32))
    change_x, change_y = slopes.x[0] - slopes.x[1], slopes.y[2] - slopes.y[3]
    return np.concatenate([change_x, change_y]).astype(np.float64) / (2 * _STEP_PX)
