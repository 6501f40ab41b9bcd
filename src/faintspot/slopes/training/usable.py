"""Sub-apertures of recorded frames from whose spots something can be learnt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.flags import KEEPABLE, SubapertureFlag, leave_out
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.mean_frame import MeanFrame
from faintspot.slopes.pipeline.light import MeanLight
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout

_CLEARLY_LIT = 5.0  # of the median sub-aperture: a fifth of its flux would still show
_DOUBTFUL = (SubapertureFlag.TOO_MANY_BAD_PIXELS, *KEEPABLE.values())


def usable_subapertures(
    frames: NDArray[np.generic], layout: Layout, calibration: Calibration
) -> tuple[NDArray[np.bool_], str]:
    """Return which sub-apertures show spots, (n,), and the line that says which are left out.

    A sub-aperture is left out if the mean frame shows it dark while most are clearly lit, or if most frames
    flag its slope as limited, unlike its neighbours', or of too many bad pixels.

    Parameters
    ----------
    frames : (h, w) or (n_frames, h, w) array, ADU
    layout : Layout
    calibration : Calibration

    Raises
    ------
    InputError
        If none is left.
    """
    pipeline = SlopePipeline(layout, Settings("brightest"), calibration)
    frames = frames.reshape(-1, *layout.frame_shape)
    found = pipeline(frames).flags
    flags = np.zeros(len(layout), np.uint8)
    for flag in _DOUBTFUL:
        flags[2 * np.count_nonzero(found & flag, axis=0) > len(found)] |= int(flag)
    light = MeanLight(layout, pipeline.light_test.maps, pipeline.plan.typical_fwhm_px)
    mean = MeanFrame(layout.frame_shape)
    mean.add(frames)
    significance = light.significances(mean.mean)
    if np.median(significance) > _CLEARLY_LIT:
        flags[significance < 1.0] |= int(SubapertureFlag.NO_FLUX)
    usable, line = leave_out(flags)
    if not usable.any():
        raise InputError(f"frames: expected spots in the sub-apertures, {line}")
    return usable, line
