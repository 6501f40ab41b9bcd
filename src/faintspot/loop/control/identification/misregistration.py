"""Shift, rotation and magnification of the mirror, and gains of its actuators, from the telemetry of a loop.

Slopes that a filter has not predicted are new turbulence and noise, which past commands do not know. With a
wrong interaction matrix they also hold a part of the commands that act: its errors times these commands, as
the filter passes them. So regression of the former on the latter gives the errors of the matrix
(prediction-error method, Ljung 1999, System Identification, section 8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from faintspot.base.arrays import Floats
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import Measured, runs_of
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.slope_spectra import interpolated
from faintspot.loop.control.kalman.predictor import SlopePredictor

_OVERSAMPLED, _MARGIN = 4, 2  # nodes a sub-aperture; sub-apertures around the sensor
_SMOOTHNESS = 1e-3  # of surfaces of the mirror, which follow slopes to 2e-4 of their power
_STEPS = np.array([0.05, 0.05, 0.02, 0.02])  # of derivatives
_MODEL_ERRORS = np.array([0.04, 0.04, math.radians(0.5), 0.02])
"""Errors of shifts, rotation and magnification by the filter's own, found in loops with right matrices."""
_COLUMN_ERROR, _COLUMN_PRIOR = 0.08, 0.3  # likewise, of the gain of a command; expected scatter of gains
_SETTLED = 100  # frames
_MOST_FRAMES = 1000
_UPDATES = 3
_SURE, _SURE_OF_ONE, _SURE_OF_ALL = 3.0, 4.0, 5.0
"""Standard errors from which on a matrix is corrected; of one of many commands; of the scatter of all."""


@dataclass(frozen=True, eq=False)
class Misregistration:
    """Change of a mirror since its interaction matrix was measured."""

    moved: Floats
    """(4,): shift along x and y (sub-apertures), rotation from x to y (rad), magnification minus 1."""
    error: Floats
    """(4,): standard errors."""
    gains: Floats
    """(commands,): gain of each command relative to the matrix; of all together 1."""
    gain_error: Floats

    @property
    def has_moved(self) -> bool:
        """Whether it has moved beyond the errors."""
        return bool((np.abs(self.moved) > _SURE * self.error).any())

    @cached_property
    def factors(self) -> Floats:
        """(commands,): factors by which columns are corrected: of each that is wrong for sure, or of all.

        If the others scatter more than their errors, they are corrected by what these leave sure.
        """
        change, variance = self.gains - 1, np.square(self.gain_error)
        away = np.square(change) / variance
        is_sure = away > _SURE_OF_ONE**2
        known = np.isfinite(variance) & ~is_sure
        factors, n = np.where(is_sure, self.gains, 1.0), int(known.sum())
        scatter = float((np.square(change) - variance)[known].sum()) / max(n, 1)
        if away[known].sum() > n + _SURE_OF_ALL * math.sqrt(2 * n) and scatter > 0:
            factors[known] += (change * scatter / (scatter + variance))[known]
        return factors

    @property
    def is_wrong(self) -> bool:
        """Whether anything is corrected."""
        return self.has_moved or bool((self.factors != 1).any())

    def corrected(self, matrix: MovableMatrix) -> Floats:
        """Return the corrected matrix."""
        return matrix.at(self.moved if self.has_moved else np.zeros(4)) * self.factors

    def measured(self) -> list[Measured]:
        """Return shifts, rotation and magnification with their errors."""
        names = "mirror moved along x", "mirror moved along y", "mirror turned", "mirror magnified"
        units, factors = ("pitches", "pitches", "degrees", "%"), (1, 1, math.degrees(1), 100)
        return [
            Measured(name, unit, float(factor * value), float(factor * error))
            for name, unit, factor, value, error in zip(
                names, units, factors, self.moved, self.error, strict=True
            )
        ]

    def remarks(self) -> list[str]:
        """Return what is corrected, a line each."""
        (x, y, turned, larger), errors = self.moved, self.error
        lines, changed = [], self.factors[self.factors != 1]
        if self.has_moved:
            lines.append(
                f"the mirror has moved by ({x:.2f} +- {errors[0]:.2f}, {y:.2f} +- {errors[1]:.2f}) "
                f"sub-apertures, turned by {math.degrees(turned):.1f} +- {math.degrees(errors[2]):.1f} "
                f"degrees and grown by {larger:.1%} +- {errors[3]:.1%}: its matrix is corrected"
            )
        if len(changed):
            lines.append(
                f"{len(changed)} of {len(self.factors)} commands move the mirror {changed.min():.2f} to "
                f"{changed.max():.2f} times as much as in the matrix, which is corrected"
            )
        return lines


class MovableMatrix:
    """Interaction matrix of a mirror that moves relative to the lenslets.

    Columns are taken for mean gradients of the smoothest surfaces that have these slopes.

    Parameters
    ----------
    cells : (n, 2) array of int
        Row and column of each sub-aperture.
    matrix : (2 n, commands) array
    """

    def __init__(self, cells: NDArray[np.int64], matrix: Floats) -> None:
        self._cells = cells - cells.min(axis=0)
        self._matrix = matrix
        side = self._cells.max(axis=0) + 1
        self._centre, self._nodes = side / 2, (side + 2 * _MARGIN) * _OVERSAMPLED + 1
        still = self._gradients(np.zeros(4))
        rough = _roughness(*self._nodes)
        system = still.T @ still + _SMOOTHNESS * _OVERSAMPLED**2 * rough
        self._surfaces = splu((system + 1e-9 * sparse.eye(system.shape[0])).tocsc()).solve(still.T @ matrix)
        self._still = still @ self._surfaces

    def at(self, moved: Floats) -> Floats:
        """Return the matrix of a mirror that has moved; see `Misregistration.moved`."""
        return np.asarray(self._matrix + self._gradients(moved) @ self._surfaces - self._still)

    def changes(self, moved: Floats) -> list[Floats]:
        """Return derivatives of the matrix with respect to each number."""
        steps = np.diag(_STEPS)
        both = [[self._gradients(moved + sign * step) for sign in (1, -1)] for step in steps]
        return [
            (up - down) @ self._surfaces / (2 * size) for (up, down), size in zip(both, _STEPS, strict=True)
        ]

    def _gradients(self, moved: Floats) -> sparse.csr_array:
        """Return the matrix from nodes to mean gradients, with the lenslets moved the other way."""
        x, y, turned, larger = moved
        along = (np.arange(_OVERSAMPLED) + 0.5) / _OVERSAMPLED
        rows, columns, values = [], [], []
        back = np.array(
            [[math.cos(turned), math.sin(turned)], [-math.sin(turned), math.cos(turned)]]
        )  # (y, x)
        for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)):
            across = np.full(_OVERSAMPLED, float(sign > 0))
            edge = np.column_stack([along, across] if axis == 0 else [across, along])
            points = (
                (self._cells[:, None] + edge - self._centre) @ back / (1 + larger) + self._centre - (y, x)
            )
            grid = np.clip((points + _MARGIN) * _OVERSAMPLED, 0, self._nodes - 1.001)
            first, part = grid.astype(int), grid % 1
            for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
                weight = np.abs(1 - down - part[..., 0]) * np.abs(1 - right - part[..., 1])
                number = (first[..., 0] + down) * self._nodes[1] + first[..., 1] + right
                rows.append(np.repeat(axis * len(self._cells) + np.arange(len(self._cells)), _OVERSAMPLED))
                columns.append(number.ravel())
                values.append(sign / _OVERSAMPLED * weight.ravel())
        shape = 2 * len(self._cells), int(self._nodes.prod())
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_array(entries, shape=shape)


def _roughness(rows: int, columns: int) -> sparse.csr_array:
    """Return the bending energy of a surface on nodes as a quadratic form."""
    second = [
        sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n)) for n in (rows, columns)
    ]
    first = [sparse.diags_array([1.0, -1.0], offsets=[0, 1], shape=(n - 1, n)) for n in (rows, columns)]
    down = sparse.kron(second[0], sparse.eye_array(columns))
    right = sparse.kron(sparse.eye_array(rows), second[1])
    twisted = sparse.kron(*first)
    return sparse.csr_array(down.T @ down + right.T @ right + 2 * twisted.T @ twisted)


def misregistration(
    loop: Recording, delay: LoopDelay, matrix: MovableMatrix, predictor: SlopePredictor
) -> Misregistration:
    """Measure the change of a mirror, from the longest run of a closed loop without a gap.

    Parameters
    ----------
    loop : Recording
        As `prepared`.
    delay : LoopDelay
        Its delay and centroid gain.
    matrix : MovableMatrix
        As it was measured.
    predictor : SlopePredictor
        Filter of the open-loop slopes.
    """
    run, frames = runs_of(loop.frame), max(1, round(delay.delay_frames))
    rows = np.flatnonzero(run == np.bincount(run).argmax())[-_MOST_FRAMES - frames :]
    slopes = loop.slopes[rows] / delay.gains(len(loop.cells))
    return change_of_mirror(slopes, loop.commands[rows], matrix, predictor, frames, delay.misfit)


def change_of_mirror(
    slopes: Floats,
    commands: Floats,
    matrix: MovableMatrix,
    predictor: SlopePredictor,
    delay: int,
    misfit: float = 1.0,
) -> Misregistration:
    """Measure the change of a mirror from consecutive frames of a closed loop.

    Parameters
    ----------
    slopes : (frames, m) array
        Residual slopes, divided by their centroid gain; NaN where not measured.
    commands : (frames, commands) array
        Computed from the same frames.
    matrix : MovableMatrix
    predictor : SlopePredictor
    delay : int
        Frames.
    misfit : float
        Factor on the errors of the model, where spectra are unlike those of turbulence.
    """
    acting = commands[:-delay] - commands[:-delay].mean(axis=0)
    measured = np.isfinite(slopes)
    known = np.asarray(measured.any(axis=0))
    residual = np.zeros((len(acting), len(known)))  # slopes never measured: as if the mirror corrected all
    residual[:, known] = interpolated(slopes[:, known], measured[:, known])[delay:]
    residual -= residual.mean(axis=0)
    moved, gains = np.zeros(4), np.ones(acting.shape[1])
    commanded = np.flatnonzero(acting.any(axis=0))
    for update in range(_UPDATES):
        now = gains * matrix.at(moved)
        signals = [
            acting @ change.T for change in (now, *(gains * change for change in matrix.changes(moved)))
        ]
        if update > 0:
            signals += [np.outer(acting[:, number], now[:, number]) for number in commanded]
        surprises, scale = _whitened(predictor, residual - acting @ now.T, signals)
        prior = np.concatenate([np.zeros(5), np.full(len(signals) - 5, 1 / _COLUMN_PRIOR)])
        change, error = _regression(surprises, prior)
        moved = moved + change[1:5]
        if update > 0:
            gains[commanded] *= 1 + change[5:] - change[5:].mean()
    gain_error = np.full(len(gains), np.inf)
    gain_error[commanded] = np.hypot(scale * error[5:], misfit * _COLUMN_ERROR)
    of_model = misfit * _MODEL_ERRORS
    return Misregistration(moved, np.hypot(scale * error[1:5], of_model), gains, gain_error)


def _whitened(predictor: SlopePredictor, slopes: Floats, signals: list[Floats]) -> tuple[Floats, float]:
    """Return surprises of slopes and signals in standard deviations, (values, 1 + k); rms of the former."""
    model, usual = predictor.model, predictor.usual_px2
    gain = np.linalg.solve(usual, predictor.with_slopes.T).T
    observed, answer = model.observation.astype(np.float32), (model.onward @ gain).astype(np.float32)
    onward = (model.onward - model.onward @ gain @ model.observation).astype(np.float32)
    together = np.stack([slopes, *signals], axis=2).astype(np.float32)
    state, surprises = np.zeros((len(onward), together.shape[2]), np.float32), np.empty_like(together)
    for frame, values in enumerate(together):
        surprises[frame] = values - observed @ state
        state = onward @ state + answer @ values
    weight = np.linalg.cholesky(np.linalg.inv(usual)).T
    white = (weight @ surprises[_SETTLED:].astype(np.float64)).reshape(-1, together.shape[2])
    return white, max(1.0, float(white[:, 0].std()))


def _regression(surprises: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Return coefficients of the first column on the others, and their errors, for a prior of 1 / width."""
    first, others = surprises[:, 0], surprises[:, 1:]
    covariance = np.linalg.pinv(others.T @ others + np.diag(np.square(prior)), hermitian=True)
    return covariance @ (others.T @ first), np.sqrt(np.diag(covariance))
