"""Response of slopes to a displacement of the spots, from displaced frames."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

Floats = NDArray[np.float64]

_STEP_PX = 0.25


def response(pipeline: SlopePipeline, mean_frame: Floats, frames: Iterable[NDArray[Any]]) -> Floats:
    """Return the slopes shown for a displacement of 1 px, (2 n,), all x, then all y.

    Slopes with fixed weights are linear in the pixels: their mean change, when all spots are displaced, is
    the change for the displaced mean of the frames. Others are measured in single frames displaced by whole
    pixels, which leave the noise as it is. The mean change over Gaussian displacements is the regression of
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
            dark + ndimage.shift(light, sign * np.array(direction), order=order, mode="nearest")
            for sign in (1, -1)
        )
        ahead, behind = (getattr(pipeline(each.astype(np.float32)), axis) for each in (ahead, behind))
        changes.append((ahead.astype(np.float64) - behind) / (2 * step_px))
    return np.hstack(changes).T
