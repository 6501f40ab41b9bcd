"""Slopes of a closed loop from telemetry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.telemetry.recording import Telemetry
from faintspot.loop.control.configuration import NONE, STREAM, Control
from faintspot.loop.control.identification.model import INTEGRATOR, MODAL
from faintspot.loop.control.telemetry import without_prior
from faintspot.loop.telemetry.recording import CLOSED, check_commands, recorded_slopes

Floats = NDArray[np.float64]

_EVEN_TRUST = 0.2  # trust above which weights are equal, to avoid selecting the best moments
FEWEST_FRAMES = 200


@dataclass(frozen=True, eq=False)
class LoopTelemetry:
    """Frames of a closed loop with one configuration and m slopes."""

    segment: NDArray[np.int64]
    """Number of the segment, (frames,): equal for consecutive frames without a gap."""
    slopes_px: Floats
    """Slopes of the frame alone, (frames, m), without the estimator's prior, not divided by the centroid
    gain; any finite number if not measured."""
    trust: Floats
    """Weight of each slope, (frames, m); see `faintspot.loop.control.telemetry.OpenLoopTelemetry`."""
    held_px: Floats
    """Contribution of the mirror to the slopes, (frames, m)."""
    rate_hz: float

    def __len__(self) -> int:
        return len(self.segment)

    @property
    def since(self) -> NDArray[np.int64]:
        """Frames since the segment began, (frames,)."""
        starts = np.flatnonzero(np.concatenate([[True], np.diff(self.segment) != 0]))
        return np.arange(len(self)) - np.repeat(starts, np.diff(np.append(starts, len(self))))

    def weighted(self, gain: float = 1.0) -> tuple[Floats, Floats]:
        """Return residual and open-loop slopes, (frames, m) px, each with a weight of mean 1.

        Parameters
        ----------
        gain : float
            Centroid gain.
        """
        trust = np.minimum(self.trust, _EVEN_TRUST)
        mean = trust.mean(axis=0)
        weight = trust / np.where(mean > 0, mean, 1.0)
        residual = weight * self.slopes_px / gain
        return residual, residual - weight * self.held_px


def seen_in_telemetry(
    telemetry: Telemetry, control: Control, prior_px: Floats | None = None
) -> LoopTelemetry:
    """Return the slopes of an engine's closed loop.

    Parameters
    ----------
    telemetry : faintspot.io.Telemetry
        Telemetry of a single configuration.
    control : Control
        Control of the engine: matrix, delay and centroid gain.
    prior_px : (m,) array, optional
        Width of the estimator's prior. Default: no prior.

    Raises
    ------
    InputError
        When there are too few frames of a closed loop, another number of commands, no standard errors, or an
        estimator whose prior had a mean that is no longer known.
    """
    check_commands(telemetry, control, "telemetry")
    predicted = control.prediction != NONE and prior_px is not None
    if predicted and (control.options.controller not in (INTEGRATOR, MODAL) or control.prediction == STREAM):
        raise InputError(
            "telemetry: expected an integrator, because the predictions that other controllers or programs "
            "gave to the estimator are not recorded"
        )
    rows = _usable(telemetry, control.options.delay_frames)
    if len(rows) < FEWEST_FRAMES:
        raise InputError(f"telemetry: expected {FEWEST_FRAMES} frames of a closed loop, got {len(rows)}")
    slopes, error, mirror, expected = recorded_slopes(telemetry, control, rows, predicted, "telemetry")
    measured, _, trust = without_prior(slopes, error, expected, prior_px)
    frame, times = telemetry.frame[rows], telemetry.last_row_time_ns[rows]
    rate = (frame[-1] - frame[0]) / max(float(times[-1] - times[0]) / 1e9, 1e-9)
    segment = np.concatenate([[0], np.cumsum(np.diff(frame) != 1)])
    return LoopTelemetry(segment, measured, trust, mirror, float(rate))


def _usable(telemetry: Telemetry, delay: int) -> NDArray[np.int64]:
    """Return the frames of a closed loop with known mirror commands."""
    frame, closed = np.asarray(telemetry.frame), np.asarray(telemetry.loop) == CLOSED
    if len(frame) <= delay:
        return np.empty(0, np.int64)
    usable = (frame[delay:] - frame[:-delay] == delay) & closed[delay:] & closed[:-delay]
    return np.flatnonzero(usable) + delay
