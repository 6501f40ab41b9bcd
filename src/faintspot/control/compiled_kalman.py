"""The guarded Kalman filter in compiled code: from a frame's slopes to a command in one call."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.control.base import Expected
from faintspot.control.commands import CommandLine
from faintspot.control.compiled import add_products
from faintspot.control.guarded import CORRELATED_FRAMES, FEWEST_FRAMES, MEMORY_FRAMES, STANDARD_ERRORS
from faintspot.control.kalman import LARGEST_VARIANCE_PX2, SlopePredictor, shares
from faintspot.control.telemetry import LEAST_SHARE, LEAST_VARIANCE_PX2
from faintspot.kernels.compiling import Direct, compiled_with

Floats = NDArray[np.float64]

_compiled = partial(compiled_with, source=__file__)

STEPS = 3
"""Of conjugate gradients, for how much each slope corrects."""
_NO_PRIOR = np.zeros(0)

# Rows of memory: slopes; and commands, of which the first four are what is turned into slopes.
_HELD, _HELD_LEARNT, _HELD_PLAIN, _LATEST_PLAIN, _LEFT_LEARNT, _LEFT_PLAIN, _FOR_PLAIN = range(7)
_VARIANCE, _SCALE, _SURPRISE, _SOLUTION, _DIRECTION, _IMAGE, _SPARE, _PREDICTED = range(7, 15)
_SLOPE_ROWS = 15
_WAVEFRONT = 4
_COMMAND_ROWS = 7
# Of the guard: 1 where the plain one's commands go out; frames; mean difference of late, and its mean square.
_CHOSEN, _FRAMES, _MEAN, _SQUARE = range(4)


class _Matrices(NamedTuple):
    """What does not change, each transposed: what a product adds up lies side by side."""

    interaction: Any
    """(commands, m)"""
    reconstruct: Any
    """(m, commands)"""
    with_slopes: Any
    """(m, states): covariance of the state's error with the slopes' before a frame is measured."""
    predicted: Any
    """(m, m): of the slopes' error."""
    usual_inverse: Any
    """(m, m): of the slopes' covariance with their usual noise."""
    usual_variance: Any
    """(m,): its diagonal, before it was inverted."""
    onward: Any
    """(layers, 2 m, m)"""
    command: Any
    """(states, commands): from the state."""


class _Lines(NamedTuple):
    """Commands on their way: to the mirror, and those of the two controllers."""

    true: Any
    """(delay + 1, commands)"""
    learnt: Any
    plain: Any


class _Memory(NamedTuple):
    """What goes on from frame to frame, and what is made in between."""

    state: Any
    """(layers, 2, m): as predicted for the coming frame."""
    guard: Any
    """(4,)"""
    slopes: Any
    """(_SLOPE_ROWS, m)"""
    commands: Any
    """(_COMMAND_ROWS, commands)"""


@_compiled
def _take(slopes: Any, errors: Any, prior_std: Any, noise_factor: Any, rows: Any, chosen: Any) -> None:
    """Write what both controllers make of slopes; see `Guarded.update` and `telemetry.without_prior`."""
    for s in range(slopes.shape[0]):
        held, of_learnt, of_plain = rows[_HELD, s], rows[_HELD_LEARNT, s], rows[_HELD_PLAIN, s]
        latest = rows[_LATEST_PLAIN, s]
        measured = errors[s] < math.inf
        variance = max(errors[s] * errors[s], LEAST_VARIANCE_PX2)
        alone, trust = slopes[s], 1.0 if measured else 0.0
        if prior_std.shape[0] > 0:
            expected = held - latest if chosen else held + rows[_PREDICTED, s]
            prior = prior_std[s] * prior_std[s]
            share = max(prior / variance - 1.0, LEAST_SHARE)
            alone = expected + (slopes[s] - expected) * (1.0 + share) / share
            variance = prior / share
            trust = trust * share / (1.0 + share)
        open_loop = alone - held
        rows[_LEFT_LEARNT, s] = trust * (open_loop + of_learnt)
        residual, expects = open_loop + of_plain, of_plain - latest
        rows[_LEFT_PLAIN, s] = trust * residual
        rows[_FOR_PLAIN, s] = expects + trust * (residual - expects)
        noise = noise_factor * variance
        measured = measured and noise < LARGEST_VARIANCE_PX2
        rows[_VARIANCE, s] = noise if measured else math.inf
        rows[_SURPRISE, s] = open_loop - rows[_PREDICTED, s] if measured else 0.0


@_compiled
def _solve(matrices: Any, rows: Any, steps: Any) -> None:
    """Write x with (S + V) x = surprise: S of the predicted slopes' error, V of this frame's noise.

    Conjugate gradients among the slopes that were measured. What they are preconditioned by is the inverse
    for the usual noise, scaled to this frame's variances: nearly the solution, where noise is not much other
    than usual.
    """
    m = rows.shape[1]
    variance, scale, left = rows[_VARIANCE], rows[_SCALE], rows[_SURPRISE]
    solution, direction = rows[_SOLUTION], rows[_DIRECTION]
    for s in range(m):
        own = matrices.predicted[s, s]
        scale[s] = math.sqrt(matrices.usual_variance[s] / (own + variance[s]))  # 0: not measured
        solution[s] = direction[s] = 0.0
    before = 0.0
    for _ in range(steps):
        for s in range(m):
            rows[_SPARE, s] = scale[s] * left[s]
            rows[_IMAGE, s] = 0.0
        add_products(matrices.usual_inverse, rows[_SPARE : _SPARE + 1], rows[_IMAGE : _IMAGE + 1])
        descent = 0.0
        for s in range(m):
            rows[_IMAGE, s] *= scale[s]
            descent += rows[_IMAGE, s] * left[s]
        if not descent > 0.0:
            return
        more = descent / before if before > 0.0 else 0.0
        before = descent
        for s in range(m):
            direction[s] = rows[_IMAGE, s] + more * direction[s]
            rows[_IMAGE, s] = 0.0
        add_products(matrices.predicted, rows[_DIRECTION : _DIRECTION + 1], rows[_IMAGE : _IMAGE + 1])
        curvature = 0.0
        for s in range(m):
            if scale[s] > 0.0:
                rows[_IMAGE, s] += variance[s] * direction[s]
                curvature += direction[s] * rows[_IMAGE, s]
        step = descent / curvature
        for s in range(m):
            if scale[s] > 0.0:
                solution[s] += step * direction[s]
                left[s] -= step * rows[_IMAGE, s]


@_compiled
def _advance(matrices: Any, memory: Any) -> None:
    """Correct the state, write the command that follows into the first row, and go on to the next frame."""
    state, rows, commands = memory.state, memory.slopes, memory.commands
    m, whole = rows.shape[1], state.reshape(1, state.size)
    add_products(matrices.with_slopes, rows[_SOLUTION : _SOLUTION + 1], whole)
    commands[0] = 0.0
    add_products(matrices.command, whole, commands[:1])
    rows[_PREDICTED] = 0.0
    for layer in range(state.shape[0]):
        rows[_IMAGE] = 0.0
        both = state[layer].reshape(1, 2 * m)
        add_products(matrices.onward[layer], both, rows[_IMAGE : _IMAGE + 1])
        for s in range(m):
            state[layer, 1, s] = state[layer, 0, s]
            state[layer, 0, s] = rows[_IMAGE, s]
            rows[_PREDICTED, s] += rows[_IMAGE, s]


@_compiled
def _choose(guard: Any, learnt: Any, plain: Any) -> None:
    """Let the one that leaves less have the mirror; see `Guarded`."""
    difference = (learnt - plain) / max(learnt + plain, 1e-30)
    guard[_FRAMES] += 1.0
    share = 1.0 / min(guard[_FRAMES], MEMORY_FRAMES)
    guard[_MEAN] += share * (difference - guard[_MEAN])
    guard[_SQUARE] += share * (difference * difference - guard[_SQUARE])
    if guard[_FRAMES] < FEWEST_FRAMES:
        return
    values = min(guard[_FRAMES], 2 * MEMORY_FRAMES) / CORRELATED_FRAMES
    variance = max(0.0, guard[_SQUARE] - guard[_MEAN] * guard[_MEAN]) / values
    if abs(guard[_MEAN]) > STANDARD_ERRORS * math.sqrt(variance):
        guard[_CHOSEN] = 1.0 if guard[_MEAN] > 0.0 else 0.0


@_compiled
def follow(
    slopes: Any,
    errors: Any,
    prior_std: Any,
    noise_factor: Any,
    gain: Any,
    keep: Any,
    largest: Any,
    steps: Any,
    matrices: Any,
    lines: Any,
    places: Any,
    memory: Any,
) -> float:
    """Write the next command of both controllers and of the mirror; return the sum of the filter's.

    Parameters
    ----------
    slopes, errors : (m,) float64 arrays
        Finite; infinite error: not measured.
    prior_std : (m,) or (0,) float64 array
        Prior of the estimator; none.
    noise_factor, gain, keep, largest : float
        Of the errors' variances; the integrator's gain, and what it keeps of its command; stroke.
    steps : int
        Of conjugate gradients.
    matrices, lines, memory
    places : (int, int, int)
        Where the lines' next commands go.
    """
    rows, commands = memory.slopes, memory.commands
    here, of_learnt, of_plain = places
    length, chosen = lines.true.shape[0], memory.guard[_CHOSEN] > 0.0
    for c in range(commands.shape[1]):
        commands[_HELD, c] = lines.true[(here + 1) % length, c]
        commands[_HELD_LEARNT, c] = lines.learnt[(of_learnt + 1) % length, c]
        commands[_HELD_PLAIN, c] = lines.plain[(of_plain + 1) % length, c]
        commands[_LATEST_PLAIN, c] = lines.plain[(of_plain + length - 1) % length, c]
    rows[:_LEFT_LEARNT] = 0.0
    add_products(matrices.interaction, commands[:_WAVEFRONT], rows[:_LEFT_LEARNT])
    _take(slopes, errors, prior_std, noise_factor, rows, chosen)
    commands[_WAVEFRONT:] = 0.0
    add_products(matrices.reconstruct, rows[_LEFT_LEARNT : _FOR_PLAIN + 1], commands[_WAVEFRONT:])
    left_learnt, left_plain = 0.0, 0.0
    for c in range(commands.shape[1]):
        left_learnt += commands[_WAVEFRONT, c] * commands[_WAVEFRONT, c]
        left_plain += commands[_WAVEFRONT + 1, c] * commands[_WAVEFRONT + 1, c]
    _choose(memory.guard, left_learnt, left_plain)
    _solve(matrices, rows, steps)
    _advance(matrices, memory)
    plainly, total = memory.guard[_CHOSEN] > 0.0, 0.0
    for c in range(commands.shape[1]):
        own, other = commands[0, c], keep * commands[_LATEST_PLAIN, c] - gain * commands[_WAVEFRONT + 2, c]
        total += own
        own, other = min(max(own, -largest), largest), min(max(other, -largest), largest)
        lines.learnt[of_learnt, c], lines.plain[of_plain, c] = own, other
        lines.true[here, c] = other if plainly else own
    return total


_FOLLOW = Direct(follow)


class CompiledKalman:
    """`guarded.Guarded` with `predictive.Predictive` and the integrator beside it, in compiled code.

    How much each slope corrects follows the noise of each frame, as in `SlopePredictor`; in place of solving
    its equations to the end it takes `STEPS` steps of conjugate gradients, which is products with matrices.

    Parameters
    ----------
    line : CommandLine
        To the mirror.
    interaction : (m, commands) array
    reconstruct : (commands, m) array
        From slopes to what is compared, and what the integrator integrates.
    predictor : SlopePredictor
    clean : (commands, m) array
        The wavefront, as commands that cause it, from open-loop slopes without noise.
    plain_gain, leak : float
        Of the integrator.
    prior_std_px : (m,) array, optional
        Prior of the estimator, whose mean is `expected`. Default: it has none.
    noise_factor : float
        What to multiply the variances of standard errors by.
    prefers_plain : bool
        Whether the integrator begins.
    """

    undoes_prior = False

    def __init__(
        self,
        line: CommandLine,
        interaction: Floats,
        reconstruct: Floats,
        predictor: SlopePredictor,
        clean: Floats,
        plain_gain: float,
        leak: float,
        *,
        prior_std_px: Floats | None = None,
        noise_factor: float = 1.0,
        prefers_plain: bool = False,
        steps: int = STEPS,
    ) -> None:
        self._line, self._interaction = line, interaction
        slopes, commands = interaction.shape
        self._learnt, self._plain = (CommandLine(commands, line.delay_frames, line.largest) for _ in range(2))
        self.prior_std_px = prior_std_px
        ahead = -clean @ predictor.model.ahead(line.delay_frames)
        usual = predictor.usual_px2
        self._matrices = _Matrices(
            np.ascontiguousarray(interaction.T),
            np.ascontiguousarray(reconstruct.T),
            np.ascontiguousarray(predictor.with_slopes.T),
            predictor.predicted_px2,
            np.linalg.inv(usual),
            np.diag(usual).copy(),
            np.ascontiguousarray(predictor.model.both.swapaxes(1, 2)),
            np.ascontiguousarray(ahead.T),
        )
        self._lines = _Lines(line.rows, self._learnt.rows, self._plain.rows)
        self._memory = _Memory(
            np.zeros((predictor.model.layers, 2, slopes)),
            np.zeros(4),
            np.zeros((_SLOPE_ROWS, slopes)),
            np.zeros((_COMMAND_ROWS, commands)),
        )
        self._memory.guard[_CHOSEN] = prefers_plain
        self._numbers = float(noise_factor), float(plain_gain), 1.0 - leak, float(line.largest), steps
        self._std_px, self._shares = predictor.std_px, shares(predictor.model)

    @property
    def chosen(self) -> int:
        """0: the filter's commands go out; 1: the integrator's."""
        return int(self._memory.guard[_CHOSEN])

    def expected(self) -> Expected:
        """See `Controller`."""
        line = self._line
        if self.chosen:
            return Expected(self._interaction @ (line.acting - self._plain.latest), None)
        mean = self._interaction @ line.acting
        mean += self._memory.slopes[_PREDICTED]
        return Expected(mean, self._std_px)

    def begin(self) -> None:
        """See `Controller`: open-loop slopes are taken to be those that the mirror takes off."""
        latest = self._line.latest
        for own in (self._learnt, self._plain):
            own.hold(latest)
        open_loop = -(self._interaction @ latest)
        self._memory.state[:] = self._shares[:, None, None] * open_loop
        self._memory.slopes[_PREDICTED] = open_loop
        self._memory.guard[_FRAMES:] = 0.0

    def update(self, slopes_px: Floats, standard_error_px: Floats) -> None:
        """See `Controller`.

        Raises
        ------
        ArithmeticError
            When the filter's numbers have become too large.
        """
        prior, places = self.prior_std_px, (self._line.place, self._learnt.place, self._plain.place)
        total = _FOLLOW(
            slopes_px,
            standard_error_px,
            _NO_PRIOR if prior is None else prior,
            *self._numbers,
            self._matrices,
            self._lines,
            places,
            self._memory,
        )
        if not math.isfinite(total):
            raise ArithmeticError("its commands were not finite")
        for line in (self._line, self._learnt, self._plain):
            line.sent()
