"""Residual wavefront of each turn of a closed loop whose methods alternated, from its slopes.

The residual slopes of a turn are divided by the centroid gain of its method (`relative_gains`). The noise,
subtracted from the residual phase, is the deviation of the turn's pseudo-open-loop slopes from parabolas in
time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.identification.open_loop import noise_variance
from faintspot.loop.control.phase import residual_phase
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.telemetry.recorded_loop import frame_rate
from faintspot.loop.turbulence.slope_covariance import ARCSEC, SlopeTurbulence
from faintspot.loop.turbulence.strength import OUTER_SCALE_M

Floats = NDArray[np.float64]

FEWEST_SCORED = 5
"""Frames of a turn after settling, of which a residual phase is computed."""
_FEWEST_MEASURED = 0.5  # of a frame's slopes, for the frame to count
_PARABOLA = 2  # frames on each side
_NOISE_ERROR = 2.5  # of Gaussian noise times its deviation from a parabola: variance in units of its square


@dataclass(frozen=True, eq=False)
class AlternatingLoop:
    """Recording of a closed loop with n sub-apertures, whose methods took turns."""

    slopes_px: NDArray[np.float32]
    """(frames, 2 n): all x, then all y; NaN where not measured."""
    commands: NDArray[np.float32]
    """(frames, commands): those computed from each frame."""
    frame: NDArray[np.int64]
    """(frames,): numbers of the frames; missing ones were lost."""
    time_s: Floats
    """(frames,): times at which their last rows arrived."""
    method: NDArray[np.int64]
    """(frames,): number of the method; negative where the loop was open."""
    conditions: NDArray[np.int64]
    """(frames,): number of the conditions, such as settings that all methods share."""
    interaction: Floats
    """(2 n, commands): slopes [px] for a unit of each command."""
    delay_frames: int
    """The command computed from frame k acts first during frame k + delay."""
    cells: NDArray[np.int64]
    """(n, 2): row and column of each sub-aperture."""
    subaperture_m: float
    pixel_scale_arcsec: float
    outer_scale_m: float | None = None

    @cached_property
    def frame_rate_hz(self) -> float:
        """See `frame_rate`."""
        return frame_rate(self.time_s, self.frame)

    @property
    def site(self) -> SlopeTurbulence:
        """Geometry and outer scale."""
        positions = np.asarray(self.cells[:, ::-1] * self.subaperture_m, np.float64)
        scale = self.pixel_scale_arcsec * ARCSEC
        outer = self.outer_scale_m or OUTER_SCALE_M
        return SlopeTurbulence(
            positions, self.subaperture_m, scale, 0.15, outer, np.ones(1), np.zeros((1, 2))
        )

    @cached_property
    def phase(self) -> Floats:
        """(commands, 2 n): from slopes [px] to amplitudes [m] whose squares add up to the variance."""
        reconstructor = make_reconstructor(self.interaction)
        per_px = self.pixel_scale_arcsec * ARCSEC * self.subaperture_m
        return per_px * residual_phase(reconstructor.clean, self.interaction, self.cells)

    def mirror(self, rows: NDArray[np.int64]) -> Floats:
        """Return the slopes of the mirror in some frames, NaN where its commands were not recorded."""
        sent = rows - self.delay_frames
        held = self.commands[np.maximum(sent, 0)].astype(np.float64) @ self.interaction.T
        known = (sent >= 0) & (self.frame[rows] - self.frame[np.maximum(sent, 0)] == self.delay_frames)
        return np.where(known[:, None], held, np.nan)


@dataclass(frozen=True)
class Turn:
    """Consecutive frames that one method measured in a closed loop."""

    method: int
    conditions: int
    begin: int
    """First row of the recording."""
    scored: int
    """First row after settling."""
    end: int
    """Row after the last."""


@dataclass(frozen=True)
class TurnPhase:
    """Residual phase of a turn."""

    variance_m2: float
    """Variance of the residual wavefront within the mirror's reach, without noise."""
    error_m2: float
    """Standard error due to the noise of the slopes alone."""


def turns_of(loop: AlternatingLoop, settle_frames: Sequence[int]) -> list[Turn]:
    """Return the turns of which enough frames are left after settling.

    A turn ends with a change of method or conditions, when the loop opens, or where frame numbers begin anew.
    The first `settle_frames[method]` frames are not scored, counted by frame number. Turns cut short, with
    less than half of the method's usual number of scored frames, are left out.
    """
    changes = (np.diff(loop.method) != 0) | (np.diff(loop.conditions) != 0) | (np.diff(loop.frame) <= 0)
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(loop.frame)]])
    turns = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        method = int(loop.method[begin])
        if method < 0:
            continue
        settled = loop.frame[begin:end] >= loop.frame[begin] + settle_frames[method]
        turns.append(
            Turn(method, int(loop.conditions[begin]), begin, end - int(np.count_nonzero(settled)), end)
        )
    usual = [
        np.median([turn.end - turn.scored for turn in turns if turn.method == method] or [0])
        for method in range(len(settle_frames))
    ]
    return [
        turn
        for turn in turns
        if turn.end - turn.scored >= max(FEWEST_SCORED, 0.5 * float(usual[turn.method]))
    ]


def phase_of_turn(loop: AlternatingLoop, turn: Turn, gain: float) -> TurnPhase | None:
    """Return the residual phase of a turn's scored frames; None if too few are known.

    Parameters
    ----------
    gain : float
        Centroid gain of the turn's method.
    """
    rows = np.arange(turn.begin, turn.end)
    residual = loop.slopes_px[rows].astype(np.float64) / gain
    variance, count = _noise(residual - loop.mirror(rows), loop.frame[rows])
    scored = residual[turn.scored - turn.begin :]
    share = np.isfinite(scored).mean(axis=1)
    usable = share >= _FEWEST_MEASURED
    if np.count_nonzero(usable) < FEWEST_SCORED or not (count > 0).any():
        return None
    phase = np.nan_to_num(scored[usable]) @ loop.phase.T
    frames = len(phase)
    mean = float((np.square(phase).sum(axis=1) / share[usable]).mean())
    weight = np.square(loop.phase).sum(axis=0)
    noise = loop.phase * np.maximum(variance, 0.0) @ loop.phase.T
    squared = float(np.square(noise).sum())
    residual_m2 = mean - float(weight @ variance)
    of_frames = 2 * squared + 4 * max(residual_m2, 0.0) * squared / max(float(np.trace(noise)), 1e-300)
    of_noise = float(np.square(weight * variance) @ (_NOISE_ERROR / np.maximum(count, 1)))
    return TurnPhase(residual_m2, math.sqrt(of_frames / frames + of_noise))


def open_loop_slopes(
    loop: AlternatingLoop, turns: Sequence[Turn], gains: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return pseudo-open-loop slopes, residual slopes and numbers of runs of consecutive frames.

    All frames of the turns whose commands are known count, settling ones included; slopes that were not
    measured are 0 about their mean.
    """
    atmosphere, residual, run = [], [], []
    for number, turn in enumerate(turns):
        rows = np.arange(turn.begin, turn.end)
        slopes = loop.slopes_px[rows].astype(np.float64) / gains[turn.method]
        open_loop = slopes - loop.mirror(rows)
        known = np.isfinite(open_loop).any(axis=1)
        atmosphere.append(open_loop[known])
        residual.append(slopes[known])
        run.append(number * len(loop.frame) + loop.frame[rows[known]] - np.arange(np.count_nonzero(known)))
    centred = []
    for parts in (atmosphere, residual):
        values = np.concatenate(parts)
        centred.append(np.nan_to_num(values - np.nanmean(values, axis=0)))
    return centred[0], centred[1], np.concatenate(run)


def _noise(open_loop: Floats, frame: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return the variance of the slopes' noise in a turn, and the number of frames that it is from."""
    grid = np.full((int(frame[-1] - frame[0]) + 1, open_loop.shape[1]), np.nan)
    if len(grid) <= 2 * _PARABOLA:
        return np.zeros(open_loop.shape[1]), np.zeros(open_loop.shape[1])
    grid[frame - frame[0]] = open_loop
    return noise_variance(grid)
