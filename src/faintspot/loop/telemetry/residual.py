"""Residual wavefront error of a loop, without the slopes' noise.

Measured slopes are residual slopes plus noise. The noise is estimated from a frame's open-loop slopes, i.e.
without the mirror's contribution: the deviation from a parabola through neighbouring frames. Noise belongs
to one frame alone, while turbulence and commands follow from its neighbours. So a configuration
is neither penalised for noise that the mirror does not produce, nor favoured by smoothing that hides the
residual. Noise that reaches the mirror through the loop counts, as it should.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.telemetry.engine_telemetry import LoopTelemetry
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront.fit import fit_wavefront

Floats = NDArray[np.float64]

SETTLE_FRAMES = 20
"""Frames at the start of a segment that are affected by what was before it."""


def wavefront_modes(layout: Layout) -> tuple[Floats, str]:
    """Return the matrix from slopes to Zernike coefficients, (k, 2 n), and their unit; see `fit_wavefront`.

    Raises
    ------
    InputError
        When the layout's sub-apertures cannot separate the modes.
    """
    n = len(layout)
    slopes = Slopes(*(np.zeros((2 * n, n), kind) for kind in RESULT_TYPES))
    slopes.x[:n], slopes.y[n:] = np.eye(n), np.eye(n)
    found = fit_wavefront(slopes, layout)
    return np.ascontiguousarray(found.coefficients.T), found.unit


def residual_wavefront(seen: LoopTelemetry, modes: Floats, gain: float = 1.0) -> Floats:
    """Return the mean square of each frame's residual wavefront without the noise, (frames,).

    In the square of the modes' unit; it may be negative for single frames. NaN near the ends of segments and
    in their first 20 frames.

    Parameters
    ----------
    seen : LoopTelemetry
    modes : (k, m) array
        See `wavefront_modes`.
    gain : float
        Centroid gain; see `faintspot.loop.telemetry.centroid_gain`.
    """
    residual, atmosphere = (each @ modes.T for each in seen.weighted(gain))
    around = np.full_like(atmosphere, np.nan)
    near, far = atmosphere[3:-1] + atmosphere[1:-3], atmosphere[4:] + atmosphere[:-4]
    around[2:-2] = (4 * near - far) / 6
    noise = (atmosphere * (atmosphere - around)).sum(axis=1)
    left: Floats = np.square(residual).sum(axis=1) - noise
    apart = np.full(len(seen), True)
    apart[2:-2] = seen.segment[4:] != seen.segment[:-4]
    left[apart | (seen.since < SETTLE_FRAMES)] = np.nan
    return left
