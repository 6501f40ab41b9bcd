"""Fried parameter of a block of frames, from its pseudo-open-loop slopes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence
from faintspot.loop.turbulence.strength import turbulence_strength

Floats = NDArray[np.float64]

FEWEST_FRAMES = 20


def r0_of_slopes(
    open_loop_px: Floats,
    residual_px: Floats,
    site: SlopeTurbulence,
    outer_scale_m: float | None = None,
    *,
    run: NDArray[np.int64] | None = None,
) -> tuple[float, float]:
    """Return r0 at 500 nm of frames and its standard error, m; NaN where it is not measured.

    Parameters
    ----------
    open_loop_px, residual_px : (frames, 2 n) array
        Pseudo-open-loop slopes, and residual slopes divided by the centroid gain.
    site : SlopeTurbulence
        Geometry; its strength and winds are not used.
    outer_scale_m : float, optional
        Outer scale, where it is known.
    run : (frames,) array of int, optional
        Frames with the same number are consecutive. Default: all are.
    """
    if len(open_loop_px) < FEWEST_FRAMES:
        return math.nan, math.nan
    run = np.zeros(len(open_loop_px), np.int64) if run is None else run
    slopes = np.asarray(open_loop_px, np.float64), np.asarray(residual_px, np.float64)
    strength = turbulence_strength(*slopes, run, site, outer_scale_m=outer_scale_m)
    return strength.r0_m, strength.r0_error_m
