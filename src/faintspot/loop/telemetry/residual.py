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
    names = Slopes.__dataclass_fields__
    fields = {name: np.zeros((2 * n, n), kind) for name, kind in zip(names, RESULT_TYPES, strict=True)}
    fields["x"][:n], fields["y"][n:] = np.eye(n), np.eye(n)
    fit = fit_wavefront(Slopes(**fields), layout)
    return np.ascontiguousarray(fit.coefficients.T), fit.unit


def residual_wavefront(telemetry: LoopTelemetry, modes: Floats, gain: float = 1.0) -> Floats:
    """Return the mean square of each frame's residual wavefront without the noise, (frames,).

    In the square of the modes' unit; it may be negative for single frames. NaN near the ends of segments and
    in their first 20 frames.

    Parameters
    ----------
    telemetry : LoopTelemetry
    modes : (k, m) array
        See `wavefront_modes`.
    gain : float
        Centroid gain; see `faintspot.loop.telemetry.centroid_gain`.
    """
    residual, atmosphere = (slopes @ modes.T for slopes in telemetry.weighted(gain))
    neighbours = np.full_like(atmosphere, np.nan)
    near, far = atmosphere[3:-1] + atmosphere[1:-3], atmosphere[4:] + atmosphere[:-4]
    neighbours[2:-2] = (4 * near - far) / 6
    noise = (atmosphere * (atmosphere - neighbours)).sum(axis=1)
    squares: Floats = np.square(residual).sum(axis=1) - noise
    unusable = np.full(len(telemetry), True)
    unusable[2:-2] = telemetry.segment[4:] != telemetry.segment[:-4]
    squares[unusable | (telemetry.since < SETTLE_FRAMES)] = np.nan
    return squares
