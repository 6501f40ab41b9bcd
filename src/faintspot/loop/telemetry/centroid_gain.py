"""Centroid gain from recorded images, by moving only the windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.statistics import Estimate
from faintspot.loop.control.telemetry import without_prior
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

Floats = NDArray[np.float64]

_STEP_PX = 1
_FEWEST_IMAGES = 5


def electrons_of(frames_adu: NDArray[np.floating], calibration: Calibration) -> NDArray[np.float32]:
    """Return frames in electrons after subtraction of the dark."""
    dark, electrons_per_adu = calibration.maps(frames_adu.shape[-2:])
    return np.asarray((frames_adu - dark) * electrons_per_adu, np.float32)


def calibration_of_electrons(calibration: Calibration) -> Calibration:
    """Return the calibration that remains for frames from `electrons_of`."""
    plain = replace(calibration, dark=0.0, flat=None, gain_e_per_adu=1.0, em_gain=1.0, saturation_adu=None)
    noise = calibration.read_noise_e
    return replace(
        plain, bad_pixels=None, read_noise_e=None if noise is None else noise / calibration.em_gain
    )


def shifted_gain(
    pipeline: SlopePipeline, frames_e: NDArray[np.float32], prior_px: Floats | None = None
) -> Estimate | None:
    """Return the slopes' change per pixel of spot motion, by shifting frames against their windows.

    The spots are those of the closed loop with their speckles and noise, so this is the gain that matters
    there. An estimator that is insensitive to distant spots has a small gain.

    Parameters
    ----------
    pipeline : SlopePipeline
        Pipeline for frames in electrons.
    frames_e : (images, h, w) array
    prior_px : (2 n,) array, optional
        Width of the estimator's prior, whose effect is removed. Default: no prior.

    Returns
    -------
    Estimate
        Its error is the scatter between images; None for fewer than five.
    """
    if len(frames_e) < _FEWEST_IMAGES:
        return None
    n = len(pipeline.layout)
    moved, trust = np.zeros(len(frames_e)), np.zeros(len(frames_e))
    for image, axis in ((2, 0), (1, 1)):
        ends = []
        for step in (_STEP_PX, -_STEP_PX):
            slopes = pipeline(np.roll(frames_e, step, axis=image))
            found = slopes.vector.astype(np.float64)
            error = np.hstack([slopes.standard_error_x, slopes.standard_error_y]).astype(np.float64)
            error[~np.tile(slopes.measured, 2)] = np.inf
            ends.append(without_prior(found, error, np.zeros_like(found), prior_px))
        along = slice(axis * n, (axis + 1) * n)
        weight = np.minimum(ends[0][2], ends[1][2])[:, along]
        moved += (weight * (ends[0][0] - ends[1][0])[:, along]).sum(axis=1) / (2 * _STEP_PX)
        trust += weight.sum(axis=1)
    total = trust.sum()
    if not total > 0:
        return None
    gain = float(moved.sum() / total)
    scatter = (moved - gain * trust) * len(moved) / total
    return Estimate(gain, float(scatter.std(ddof=1) / np.sqrt(len(moved))), count=len(moved))
