"""Drift of a recording: modes against time, averaged over bins, and their linear drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.slopes.wavefront.fit import Wavefront

Floats = NDArray[np.float64]

_FEWEST_BINS, _S_PER_H = 3, 3600.0


@dataclass(frozen=True)
class Drift:
    """Modes of a recording against time."""

    time: Floats
    """Middle of each bin, (bins,), in hours or frames after the first."""
    mean: Floats
    """Mean coefficients of each bin, (bins, k)."""
    standard_error: Floats
    """Their standard errors, (bins, k), from the scatter of the frames of the bin."""
    rate: Floats
    """Linear drift of each mode per hour or frame, (k,)."""
    rate_standard_error: Floats
    """Its standard error, (k,), from the scatter of the bins about the line."""
    rate_half_width: Floats
    """Half width of its 95 % interval, (k,), by Student's distribution."""
    time_unit: str
    """Unit of time: "h" or "frame"."""


def fit_drift(wavefront: Wavefront, bins: int, *, frame_rate_hz: float | None = None) -> Drift:
    """Average modes over bins of successive frames, and fit a line to the means.

    Frames need not be independent within a bin for the error of the line, as it comes from the scatter of the
    bins; that of a bin's mean takes them as independent.

    Parameters
    ----------
    wavefront : Wavefront
        Fit of the frames of a recording.
    bins : int
        Number of bins, 3 or more, with at least two fitted frames each.
    frame_rate_hz : float, optional
        Frame rate; without it, time is counted in frames.

    Raises
    ------
    InputError
        If there are too few frames, or a value is out of range.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import fit_drift
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, pixel_scale_arcsec=0.5, subaperture_m=0.6)
    >>> along_x = np.linspace(0.0, 0.5, 40)[:, None, None] * [1.0, 0.0]
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 40, flux_e=1000.0, positions=along_x * np.ones((len(layout), 1)),
    ...     rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> drift = fit_drift(fs.fit_wavefront(slopes, layout, modes=5), 8)
    >>> print(f"tip {drift.rate[0]:.0f} nm per {drift.time_unit}")
    tip 32 nm per frame
    """
    fitted = np.flatnonzero(wavefront.fitted)
    if len(fitted) < 2 * _FEWEST_BINS:
        raise InputError(f"slopes: expected at least {2 * _FEWEST_BINS} fitted frames, got {len(fitted)}")
    bins = int(number_between("bins", bins, _FEWEST_BINS, len(fitted) // 2, integer=True))
    unit, per_frame = "frame", 1.0
    if frame_rate_hz is not None:
        unit, per_frame = "h", 1 / (_S_PER_H * number_between("frame_rate_hz", frame_rate_hz, 1e-6))
    groups = np.array_split(fitted, bins)
    kept = [wavefront.coefficients[group] for group in groups]
    time = per_frame * np.array([group.mean() for group in groups])
    mean = np.stack([values.mean(axis=0) for values in kept])
    error = np.stack([values.std(axis=0, ddof=1) / np.sqrt(len(values)) for values in kept])
    since = time - time.mean()
    rate = since @ mean / (since @ since)
    residual = mean - mean.mean(axis=0) - np.outer(since, rate)
    rate_error = np.sqrt(np.sum(residual**2, axis=0) / (bins - 2) / (since @ since))
    half_width = student.ppf(0.975, bins - 2) * rate_error
    return Drift(time, mean, error, rate, rate_error, half_width, unit)
