"""Residual wavefront error of a loop, without the slopes' noise.

Measured slopes are residual slopes plus noise. The noise is estimated from a frame's open-loop slopes, i.e.
without the mirror's contribution: the deviation from a parabola through neighbouring frames. Noise belongs
to one frame alone, while turbulence and commands follow from its neighbours. So a configuration
is neither penalised for noise that the mirror does not produce, nor favoured by smoothing that hides the
residual. Noise that reaches the mirror through the loop counts, as it should.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintspot.advice.loop_telemetry import LoopTelemetry
from faintspot.experiments.loop_results import neighbour_differences
from faintspot.experiments.statistics import Estimate, paired_mean
from faintspot.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.sensor.layout import Layout
from faintspot.wavefront.fit import fit_wavefront

Floats = NDArray[np.float64]

_FEWEST_TURNS = 4
SETTLE_FRAMES = 20
"""Frames at the start of a turn that are affected by the previous configuration."""


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
    found = fit_wavefront(Slopes(**fields), layout)
    return np.ascontiguousarray(found.coefficients.T), found.unit


def residual_wavefront(seen: LoopTelemetry, modes: Floats, gains: Sequence[float] | None = None) -> Floats:
    """Return the mean square of each frame's residual wavefront without the noise, (frames,).

    In the square of the modes' unit; it may be negative for single frames. NaN near the ends of turns, and at
    their start, while the previous configuration still has an effect.

    Parameters
    ----------
    seen : Seen
    modes : (k, m) array
        See `wavefront_modes`.
    gains : sequence of float, optional
        Centroid gain of each configuration; see `faintspot.advice.centroid_gain`.
    """
    residual, atmosphere = (each @ modes.T for each in seen.weighted(gains))
    around = np.full_like(atmosphere, np.nan)
    near, far = atmosphere[3:-1] + atmosphere[1:-3], atmosphere[4:] + atmosphere[:-4]
    around[2:-2] = (4 * near - far) / 6
    noise = (atmosphere * (atmosphere - around)).sum(axis=1)
    left: Floats = np.square(residual).sum(axis=1) - noise
    apart = np.full(len(seen), True)
    apart[2:-2] = seen.turn[4:] != seen.turn[:-4]
    left[apart | (seen.since < SETTLE_FRAMES)] = np.nan
    return left


def compared_residual(
    seen: LoopTelemetry, left: Floats, gain_errors: Sequence[float] = (0.0, 0.0)
) -> Estimate:
    """Return by how much the residual of configuration 1 exceeds that of 0, interleaved with it.

    Each turn of configuration 1 is compared with the straight line between the turns of configuration 0
    before and after it. The interval is Student's t for independent differences. They are nearly independent,
    because slow changes of the turbulence cancel.

    Parameters
    ----------
    seen : Seen
    left : (frames,) array
        See `residual_wavefront`.
    gain_errors : two floats
        Relative errors of the centroid gains used for `left`.
    """
    turns, first, of_frame = np.unique(seen.turn, return_index=True, return_inverse=True)
    kept = np.isfinite(left)
    count = np.bincount(of_frame, weights=kept, minlength=len(turns))
    sums = np.bincount(of_frame, weights=np.where(kept, left, 0.0), minlength=len(turns))
    full = (count > 0) & (count >= 0.5 * np.median(count))  # most turns may be empty if frames are lost
    means, arm = sums[full] / count[full], seen.arm[first][full]
    if len(means) < _FEWEST_TURNS or len(set(arm.tolist())) < 2:
        return Estimate(math.nan)
    apart = neighbour_differences(means, np.arange(len(means), dtype=np.float64), arm == 0)
    found = paired_mean(apart[np.isfinite(apart)])
    of_gains = math.hypot(
        *(2 * error * means[arm == number].mean() for number, error in enumerate(gain_errors))
    )
    if not math.isfinite(found.standard_error) or of_gains == 0:
        return found
    widened = math.hypot(1, of_gains / max(found.standard_error, 1e-300))
    low, high = (found.value + widened * (end - found.value) for end in (found.low, found.high))
    return Estimate(found.value, widened * found.standard_error, low, high, found.count)
