"""Slopes of a closed loop from telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.control.configuration import NONE, STREAM, Control
from faintspot.control.learnt import INTEGRATOR, MODAL
from faintspot.control.recording import check_commands, recorded_slopes
from faintspot.control.telemetry import without_prior
from faintspot.io.telemetry import Telemetry

Floats = NDArray[np.float64]

_CLOSED = 2
_EVEN_TRUST = 0.2  # trust above which weights are equal, to avoid selecting the best moments
FEWEST_FRAMES = 200


@dataclass(frozen=True, eq=False)
class LoopTelemetry:
    """Consecutive frames of a closed loop, with m slopes; configurations may be interleaved."""

    arm: NDArray[np.int64]
    """Number of the configuration, (frames,)."""
    turn: NDArray[np.int64]
    """Number of the turn, (frames,): equal for consecutive frames of one configuration without a gap."""
    slopes_px: Floats
    """Slopes of the frame alone, (frames, m), without the estimator's prior, not divided by centroid gains;
    any finite number if not measured."""
    variance_px2: Floats
    """Noise variance of the slopes from the estimator, (frames, m); infinite if not measured."""
    trust: Floats
    """Weight of each slope, (frames, m); see `faintspot.control.telemetry.Telemetry`."""
    held_px: Floats
    """Contribution of the mirror to the slopes, (frames, m)."""
    rate_hz: float

    def __len__(self) -> int:
        return len(self.arm)

    @property
    def since(self) -> NDArray[np.int64]:
        """Frames since the turn began, (frames,)."""
        starts = np.flatnonzero(np.concatenate([[True], np.diff(self.turn) != 0]))
        return np.arange(len(self)) - np.repeat(starts, np.diff(np.append(starts, len(self))))

    def chosen(self, rows: NDArray[np.bool_]) -> LoopTelemetry:
        """Return selected frames; frames separated by others belong to different turns."""
        gaps = np.flatnonzero(rows[1:] & ~rows[:-1]) + 1
        turn = self.turn + np.searchsorted(gaps, np.arange(len(self)), "right") * (self.turn.max() + 1)
        return LoopTelemetry(
            self.arm[rows],
            turn[rows],
            self.slopes_px[rows],
            self.variance_px2[rows],
            self.trust[rows],
            self.held_px[rows],
            self.rate_hz,
        )

    def weighted(self, gains: Sequence[float] | None = None) -> tuple[Floats, Floats]:
        """Return residual and open-loop slopes, (frames, m) px, each with a weight (mean 1 per method).

        Parameters
        ----------
        gains : sequence of float, optional
            Centroid gain of each configuration. Default: 1.
        """
        residual, open_loop = np.empty_like(self.slopes_px), np.empty_like(self.slopes_px)
        for arm in np.unique(self.arm):
            rows = self.arm == arm
            trust = np.minimum(self.trust[rows], _EVEN_TRUST)
            mean = trust.mean(axis=0)
            weight = trust / np.where(mean > 0, mean, 1.0)
            gain = 1.0 if gains is None else gains[arm]
            residual[rows] = weight * self.slopes_px[rows] / gain
            open_loop[rows] = residual[rows] - weight * self.held_px[rows]
        return residual, open_loop


def seen_in_telemetry(
    telemetry: Telemetry, control: Control, priors_px: Sequence[Floats | None] = (None,)
) -> LoopTelemetry:
    """Return the slopes of an engine's closed loop.

    Parameters
    ----------
    telemetry : faintspot.io.Telemetry
    control : Control
        Control of the engine: matrix, delay and centroid gain.
    priors_px : sequence of (m,) arrays
        Width of the prior of each configuration's estimator, by its number; None: no prior.

    Raises
    ------
    InputError
        When there are too few frames of a closed loop, another number of commands, no standard errors, or an
        estimator whose prior had a mean that is no longer known.
    """
    check_commands(telemetry, control, "telemetry")
    predicted = control.prediction != NONE and any(prior is not None for prior in priors_px)
    if predicted and (control.options.controller not in (INTEGRATOR, MODAL) or control.prediction == STREAM):
        raise InputError(
            "telemetry: expected an integrator, because the predictions that other controllers or programs "
            "gave to the estimator are not recorded"
        )
    rows = _usable(telemetry, control.options.delay_frames)
    if len(rows) < FEWEST_FRAMES:
        raise InputError(f"telemetry: expected {FEWEST_FRAMES} frames of a closed loop, got {len(rows)}")
    slopes, error, held, expected = recorded_slopes(telemetry, control, rows, predicted, "telemetry")
    frame, arm = telemetry.frame[rows], telemetry.arm[rows]
    alone = without_priors(slopes, error, expected, arm, priors_px)
    times = telemetry.last_row_time_ns[rows]
    rate = (frame[-1] - frame[0]) / max(float(times[-1] - times[0]) / 1e9, 1e-9)
    apart = (np.diff(arm) != 0) | (np.diff(frame) != 1)
    return LoopTelemetry(arm, np.concatenate([[0], np.cumsum(apart)]), *alone, held, float(rate))


def _usable(telemetry: Telemetry, delay: int) -> NDArray[np.int64]:
    """Return the frames of a closed loop with known mirror commands."""
    frame, closed = np.asarray(telemetry.frame), np.asarray(telemetry.loop) == _CLOSED
    if len(frame) <= delay:
        return np.empty(0, np.int64)
    whole = (frame[delay:] - frame[:-delay] == delay) & closed[delay:] & closed[:-delay]
    return np.flatnonzero(whole) + delay


def without_priors(
    slopes: Floats,
    error: Floats,
    expected: Floats,
    arm: NDArray[np.int64],
    priors_px: Sequence[Floats | None],
) -> tuple[Floats, Floats, Floats]:
    """Return slopes without the prior of each configuration's estimator, their variances, and trust."""
    found = np.empty_like(slopes), np.empty_like(slopes), np.empty_like(slopes)
    for number in np.unique(arm):
        rows = arm == number
        prior = priors_px[number] if number < len(priors_px) else None
        parts = without_prior(slopes[rows], error[rows], expected[rows], prior)
        for whole, part in zip(found, parts, strict=True):
            whole[rows] = part
    return found
