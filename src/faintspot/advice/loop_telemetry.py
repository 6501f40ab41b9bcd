"""What a closed loop has seen, from telemetry."""

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
_EVEN_TRUST = 0.2  # above it weights are equal: the best spots alone would tell of the best moments
FEWEST_FRAMES = 200


@dataclass(frozen=True, eq=False)
class LoopTelemetry:
    """Consecutive frames of a closed loop, with m slopes; arms may have taken turns."""

    arm: NDArray[np.int64]
    """(frames,)"""
    turn: NDArray[np.int64]
    """(frames,): the same number for frames of one arm without a gap between them."""
    slopes_px: Floats
    """(frames, m): what the frame alone says of a slope, without the estimator's prior; not divided by the
    centroid gain. Anything finite where not measured."""
    variance_px2: Floats
    """(frames, m): of its noise, as the estimator states it; infinite: not measured."""
    trust: Floats
    """(frames, m): weight of a slope; see `faintspot.control.telemetry.Telemetry`."""
    held_px: Floats
    """(frames, m): what the mirror added to the slopes."""
    rate_hz: float

    def __len__(self) -> int:
        return len(self.arm)

    @property
    def since(self) -> NDArray[np.int64]:
        """(frames,): frames since the turn began."""
        starts = np.flatnonzero(np.concatenate([[True], np.diff(self.turn) != 0]))
        return np.arange(len(self)) - np.repeat(starts, np.diff(np.append(starts, len(self))))

    def chosen(self, rows: NDArray[np.bool_]) -> LoopTelemetry:
        """Return some of the frames; what was apart or comes apart is not one turn."""
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
        """Return residual and open-loop slopes, (frames, m) px, each with its weight, of mean 1 in an arm.

        Parameters
        ----------
        gains : sequence of float, optional
            Centroid gain of every arm. Default: 1.
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
    """Return what an engine's closed loop has seen.

    Parameters
    ----------
    telemetry : faintspot.io.Telemetry
    control : Control
        Of the engine: matrix, delay and centroid gain.
    priors_px : sequence of (m,) arrays
        How wide the prior of every arm's estimator was, by the arm's number; None: it had none.

    Raises
    ------
    InputError
        When there are too few frames of a closed loop, commands of another number, no standard errors, or an
        estimator with a prior around what is not known any more.
    """
    check_commands(telemetry, control, "telemetry")
    predicted = control.prediction != NONE and any(prior is not None for prior in priors_px)
    if predicted and (control.options.controller not in (INTEGRATOR, MODAL) or control.prediction == STREAM):
        raise InputError(
            "telemetry: expected an integrator, as what another controller or program has told the estimator "
            "to expect is not in it"
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
    """Return the frames of a closed loop whose mirror is known."""
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
    """Return slopes without the prior of each arm's estimator, their variances, and trust."""
    found = np.empty_like(slopes), np.empty_like(slopes), np.empty_like(slopes)
    for number in np.unique(arm):
        rows = arm == number
        prior = priors_px[number] if number < len(priors_px) else None
        parts = without_prior(slopes[rows], error[rows], expected[rows], prior)
        for whole, part in zip(found, parts, strict=True):
            whole[rows] = part
    return found
