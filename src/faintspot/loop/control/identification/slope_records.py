"""Open-loop slopes prepared for spectra: gaps filled, sub-apertures with too few measurements left out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.vibrations import mode_shapes
from faintspot.loop.control.telemetry import OpenLoopTelemetry
from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence

Floats = NDArray[np.float64]

_MOST_SUBAPERTURES = 60
_LEAST_MEASURED, _LEAST_MEASURED_OF_WINDOW = 0.5, 0.8  # of frames, or of slopes
_MOST_VARIANCE = 4.0  # of the median: slopes with more count as not measured. More of them hide weak layers


@dataclass(frozen=True, eq=False)
class SlopeRecords:
    """Slopes of the sub-apertures that were measured, without gaps."""

    site: SlopeTurbulence
    slopes: Floats
    """(frames, m): interpolated in time where not measured, without their mean."""
    noise_px2: Floats
    """(m,): mean variance of the noise according to the standard errors."""
    measured: NDArray[np.bool_]
    """(frames,): whether most of the slopes were measured."""

    @classmethod
    def of(cls, telemetry: OpenLoopTelemetry, site: SlopeTurbulence) -> SlopeRecords:
        """Prepare telemetry of a sensor.

        Raises
        ------
        InputError
            When no sub-aperture was measured in half of the frames.
        """
        variance = telemetry.variance_px2
        usual = np.median(np.where(np.isfinite(variance), variance, np.inf), axis=0)
        measured = variance <= _MOST_VARIANCE * usual
        measured &= np.isfinite(usual)
        n = len(site.positions_m)
        enough = measured.mean(axis=0).reshape(2, n).min(axis=0) >= _LEAST_MEASURED
        if not enough.any():
            raise InputError("telemetry: expected slopes that were measured in half of the frames, got none")
        kept = np.flatnonzero(enough)[:: math.ceil(np.count_nonzero(enough) / _MOST_SUBAPERTURES)]
        columns = np.concatenate([kept, kept + n])
        slopes = interpolated(telemetry.open_loop_px[:, columns], measured[:, columns])
        counted = np.where(measured[:, columns], variance[:, columns], np.nan)
        return cls(
            replace(site, positions_m=site.positions_m[kept]),
            slopes - slopes.mean(axis=0),
            np.nanmean(counted, axis=0),
            measured[:, columns].mean(axis=1) >= _LEAST_MEASURED,
        )

    def modes(self) -> Floats:
        """Return amplitudes of tip, tilt and focus, (frames, 3)."""
        return self.slopes @ mode_shapes(self.site.positions_m).T

    def segments(self, every: int, length: int) -> Floats:
        """Return half-overlapping pieces (pieces, length, m) of every n-th frame."""
        pieces = []
        for first in range(every):
            slopes, measured = self.slopes[first::every], self.measured[first::every]
            for start in range(0, len(slopes) - length + 1, length // 2):
                piece = slice(start, start + length)
                if measured[piece].mean() >= _LEAST_MEASURED_OF_WINDOW:
                    pieces.append(slopes[piece])
        if not pieces:
            raise InputError(
                f"telemetry: expected {every * length} frames without a gap for its spectra, got "
                f"{len(self.slopes)} frames, {np.count_nonzero(self.measured)} of them measured"
            )
        return np.array(pieces)


def interpolated(values: Floats, measured: NDArray[np.bool_]) -> Floats:
    """Return values (frames, m), interpolated in time where not measured."""
    if measured.all():
        return values
    frames, result = np.arange(len(values)), values.copy()
    for slope, usable in enumerate(measured.T):
        result[~usable, slope] = np.interp(frames[~usable], frames[usable], values[usable, slope])
    return result
