"""Kernels of the guarded Kalman filter: command from a frame's slopes, then the rest of the update.

`guarded`, `predictor` and `base` have the same steps in NumPy; `compiled` calls the kernels in their order.
"""

import math
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.loop.control import integrator
from faintspot.loop.control.base import LEAST_SHARE, LEAST_VARIANCE_PX2
from faintspot.loop.control.integrator import integrate_wavefront
from faintspot.loop.control.kalman import guard as guard_rule
from faintspot.loop.control.kalman.guard import (
    AT_LIMIT,
    HANDOVER_FRAMES,
    INTEGRATOR,
    MOST_EXCESS,
    RESIDUAL,
    SURPRISE,
    choose,
)
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2
from faintspot.slopes.kernels.compiling import Direct, _kernel
from faintspot.slopes.kernels.products import add_products

# Rows of memory: of slopes, and of commands; the first four are commands and what they add to slopes.
HELD, HELD_LEARNT, HELD_PLAIN, LATEST_PLAIN, LEFT_LEARNT, LEFT_PLAIN, FOR_PLAIN = range(7)
VARIANCE, COVARIANCE, SCALE, INNOVATION, SOLUTION, DIRECTION, IMAGE, SPARE, PREDICTED = range(7, 16)
SLOPE_ROWS = 16
MADE, LEFT, OFFSET = 4, 5, 7
COMMAND_ROWS = 8

Rows = tuple[int, int, int]
"""Where the next commands of `Lines` go."""
Numbers = tuple[float, float, Array, int]
"""The integrator's gain, what it keeps of its command, stroke, steps of conjugate gradients."""


class Matrices(NamedTuple):
    """Constant matrices, transposed so that the terms of a sum are adjacent in memory."""

    interaction: Array
    """(commands, m)"""
    reconstruct: Array
    """(m, commands)"""
    phase: Array
    """(m, commands)"""
    covariance: Array
    """(m, states): covariance of the errors of slopes and state before a measurement."""
    uncertainty: Array
    """(m, m): covariance of the slopes' error."""
    usual_inverse: Array
    """(m, m): inverse of the slopes' covariance with their usual noise."""
    usual_variance: Array
    """(m,): diagonal of that covariance."""
    onward: Array
    """(layers, 2 m, m)"""
    command: Array
    """(states, commands): matrix from the state to commands."""


class Lines(NamedTuple):
    """Delayed commands: of the mirror, and of both controllers."""

    true: Array
    """(delay + 1, commands)"""
    learnt: Array
    plain: Array


class Memory(NamedTuple):
    """State that persists between frames, and work arrays."""

    state: Array
    """(layers, 2, m): predicted state of the next frame."""
    guard: Any
    """() array of `GUARD`."""
    slopes: Array
    """(SLOPE_ROWS, m)"""
    commands: Array
    """(COMMAND_ROWS, commands)"""


class Frame(NamedTuple):
    """Slopes of a frame, which are finite, and their noise."""

    slopes: Array
    """(m,) float64"""
    errors: Array
    """(m,) float64; infinite: not measured."""
    covariance: Array
    """(m / 2,) float64: covariances of the noise of x and y."""
    prior_std: Array
    """(m,) or (0,) float64: prior of the estimator; none."""
    noise_factor: float
    """Factor on the errors' variances."""


# Compiled anew when guard or integrator change, too.
_SOURCES = __file__, guard_rule.__file__, integrator.__file__
_compiled = partial(_kernel, sources=tuple(map(Path, _SOURCES)))


@_compiled
def _take(frame: Frame, rows: Array, chosen: bool) -> None:
    """Write the inputs of both controllers; see `telemetry.without_prior`."""
    slopes, errors, covariance, prior_std, noise_factor = frame
    for s in range(slopes.shape[0]):
        caused, of_learnt, of_plain = rows[HELD, s], rows[HELD_LEARNT, s], rows[HELD_PLAIN, s]
        latest = rows[LATEST_PLAIN, s]
        measured = errors[s] < math.inf
        variance = max(errors[s] * errors[s], LEAST_VARIANCE_PX2)
        slope, trust = slopes[s], 1.0 if measured else 0.0
        if prior_std.shape[0] > 0:
            expected = caused - latest if chosen else caused + rows[PREDICTED, s]
            prior = prior_std[s] * prior_std[s]
            share = max(prior / variance - 1.0, LEAST_SHARE)
            slope = expected + (slopes[s] - expected) * (1.0 + share) / share
            variance = prior / share
            trust = trust * share / (1.0 + share)
        open_loop = slope - caused
        rows[LEFT_LEARNT, s] = trust * (open_loop + of_learnt)
        residual, expects = open_loop + of_plain, of_plain - latest
        rows[LEFT_PLAIN, s] = trust * residual
        rows[FOR_PLAIN, s] = expects + trust * (residual - expects)
        noise = noise_factor * variance
        measured = measured and noise < LARGEST_VARIANCE_PX2
        rows[VARIANCE, s] = noise if measured else math.inf
        rows[INNOVATION, s] = open_loop - rows[PREDICTED, s] if measured else 0.0
    # Of an estimator with a prior, the covariance of the frame alone is not known.
    _correlate(covariance, noise_factor if prior_std.shape[0] == 0 else 0.0, rows)


@_compiled
def _correlate(covariance: Array, factor: float, rows: Array) -> None:
    """Write the covariances of x and y, 0 where one was not measured."""
    n = covariance.shape[0]
    for s in range(n):
        measured = rows[VARIANCE, s] < math.inf and rows[VARIANCE, n + s] < math.inf
        rows[COVARIANCE, s] = factor * covariance[s] if measured else 0.0


@_compiled
def _failure(matrices: Matrices, rows: Array) -> float:
    """Return the mean square of the surprises in their expected deviations."""
    total, count = 0.0, 0.0
    for s in range(rows.shape[1]):
        if rows[VARIANCE, s] < math.inf:
            count += 1.0
            total += rows[INNOVATION, s] ** 2 / (matrices.uncertainty[s, s] + rows[VARIANCE, s])
    return total / max(count, 1.0)


@_compiled
def _solve(matrices: Matrices, rows: Array, steps: int) -> None:
    """Write x with (S + V) x = surprise: S of the predicted slopes' error, V of this frame's noise.

    Conjugate gradients among the slopes that were measured. What they are preconditioned by is the inverse
    for the usual noise, scaled to this frame's variances: nearly the solution, where noise is not much other
    than usual.
    """
    m, n = rows.shape[1], rows.shape[1] // 2
    variance, covariance, scale, residual = rows[VARIANCE], rows[COVARIANCE], rows[SCALE], rows[INNOVATION]
    solution, direction = rows[SOLUTION], rows[DIRECTION]
    for s in range(m):
        predicted = matrices.uncertainty[s, s]
        scale[s] = math.sqrt(matrices.usual_variance[s] / (predicted + variance[s]))  # 0: not measured
        solution[s] = direction[s] = 0.0
    before = 0.0
    for _ in range(steps):
        for s in range(m):
            rows[SPARE, s] = scale[s] * residual[s]
            rows[IMAGE, s] = 0.0
        add_products(matrices.usual_inverse, rows[SPARE : SPARE + 1], rows[IMAGE : IMAGE + 1])
        descent = 0.0
        for s in range(m):
            rows[IMAGE, s] *= scale[s]
            descent += rows[IMAGE, s] * residual[s]
        if not descent > 0.0:
            return
        share = descent / before if before > 0.0 else 0.0
        before = descent
        for s in range(m):
            direction[s] = rows[IMAGE, s] + share * direction[s]
        for s in range(n):
            rows[IMAGE, s] = covariance[s] * direction[n + s]
            rows[IMAGE, n + s] = covariance[s] * direction[s]
        add_products(matrices.uncertainty, rows[DIRECTION : DIRECTION + 1], rows[IMAGE : IMAGE + 1])
        curvature = 0.0
        for s in range(m):
            if scale[s] > 0.0:
                rows[IMAGE, s] += variance[s] * direction[s]
                curvature += direction[s] * rows[IMAGE, s]
        step = descent / curvature
        for s in range(m):
            if scale[s] > 0.0:
                solution[s] += step * direction[s]
                residual[s] -= step * rows[IMAGE, s]


@_compiled
def _filter(matrices: Matrices, memory: Memory, steps: int, largest: Array, command: Array) -> float:
    """Correct the state and write the filter's command; return its sum before clipping."""
    rows = memory.slopes
    state = memory.state.reshape(1, memory.state.size)
    _solve(matrices, rows, steps)
    add_products(matrices.covariance, rows[SOLUTION : SOLUTION + 1], state)
    product, total = memory.commands[MADE : MADE + 1], 0.0
    product[:] = 0.0
    add_products(matrices.command, state, product)
    for c in range(command.shape[0]):
        total += product[0, c]
        command[c] = min(max(product[0, c], -largest[c]), largest[c])
    return total


@_compiled
def _integrate(
    matrices: Matrices, memory: Memory, gain: float, keep: float, largest: Array, command: Array
) -> float:
    """Write the integrator's command; return its sum before clipping."""
    product = memory.commands[MADE : MADE + 1]
    product[:] = 0.0
    add_products(matrices.reconstruct, memory.slopes[FOR_PLAIN : FOR_PLAIN + 1], product)
    latest = memory.commands[LATEST_PLAIN]
    total: float = integrate_wavefront(product[0], latest, gain, keep, largest, command)
    return total


@_compiled
def _send(command: Array, true: Array, row: int, memory: Memory, largest: Array) -> None:
    """Write the mirror's command; see `GuardedController`."""
    guard, offset = memory.guard[()], memory.commands[OFFSET]
    if guard.sent != guard.chosen:
        guard.sent, guard.blended = guard.chosen, HANDOVER_FRAMES
        for c in range(command.shape[0]):
            offset[c] = true[row - 1, c] - command[c]
    guard.blended = max(0, guard.blended - 1)
    share = guard.blended / HANDOVER_FRAMES
    guard.measures[AT_LIMIT] = 0.0
    for c in range(command.shape[0]):
        true[row, c] = min(max(command[c] + share * offset[c], -largest[c]), largest[c])
        if abs(true[row, c]) >= largest[c]:
            guard.measures[AT_LIMIT] += 1.0


@_compiled
def _advance(matrices: Matrices, memory: Memory) -> None:
    """Predict the filter's state of the next frame."""
    state, rows = memory.state, memory.slopes
    now, m = rows[SPARE : SPARE + 1], rows.shape[1]
    rows[PREDICTED] = 0.0
    for layer in range(state.shape[0]):
        now[:] = 0.0
        add_products(matrices.onward[layer], state[layer].reshape(1, 2 * m), now)
        for s in range(m):
            state[layer, 1, s] = state[layer, 0, s]
            state[layer, 0, s] = now[0, s]
            rows[PREDICTED, s] += now[0, s]


@_compiled
def hold(matrices: Matrices, lines: Lines, next_rows: Rows, memory: Memory) -> None:
    """Write the slopes caused by the commands that act in the next frame.

    Parameters
    ----------
    matrices : Matrices
    lines : Lines
    next_rows : (int, int, int)
        Where the lines' next commands go.
    memory : Memory
    """
    rows, commands, length = memory.slopes, memory.commands, lines.true.shape[0]
    row, of_learnt, of_plain = next_rows
    for c in range(commands.shape[1]):
        commands[HELD, c] = lines.true[(row + 1) % length, c]
        commands[HELD_LEARNT, c] = lines.learnt[(of_learnt + 1) % length, c]
        commands[HELD_PLAIN, c] = lines.plain[(of_plain + 1) % length, c]
        commands[LATEST_PLAIN, c] = lines.plain[(of_plain + length - 1) % length, c]
    rows[: LATEST_PLAIN + 1] = 0.0
    add_products(matrices.interaction, commands[: LATEST_PLAIN + 1], rows[: LATEST_PLAIN + 1])


@_compiled
def follow(
    frame: Frame, numbers: Numbers, matrices: Matrices, lines: Lines, next_rows: Rows, memory: Memory
) -> float:
    """Write the selected controller's command for the mirror; return its sum before clipping.

    Parameters
    ----------
    frame : Frame
    numbers : (float, float, (commands,) array, int)
        The integrator's gain, what it keeps of its command, stroke, steps of conjugate gradients.
    matrices, lines, next_rows, memory
        As for `hold`, which was called before.
    """
    row, of_learnt, of_plain = next_rows
    gain, keep, largest, steps = numbers
    guard = memory.guard[()]
    plainly = guard.chosen == INTEGRATOR
    _take(frame, memory.slopes, plainly)
    guard.measures[SURPRISE] = _failure(matrices, memory.slopes)
    if plainly:
        total: float = _integrate(matrices, memory, gain, keep, largest, lines.plain[of_plain])
    else:
        total = _filter(matrices, memory, steps, largest, lines.learnt[of_learnt])
    _send(lines.plain[of_plain] if plainly else lines.learnt[of_learnt], lines.true, row, memory, largest)
    return total


@_compiled
def go_on(numbers: Numbers, matrices: Matrices, lines: Lines, next_rows: Rows, memory: Memory) -> float:
    """Complete a frame after its command was sent: the other controller, the guard, the state.

    Return the sum of the other controller's command before it is cut.
    """
    _, of_learnt, of_plain = next_rows
    gain, keep, largest, steps = numbers
    guard = memory.guard[()]
    if guard.chosen == INTEGRATOR:
        total: float = _filter(matrices, memory, steps, largest, lines.learnt[of_learnt])
    else:
        total = _integrate(matrices, memory, gain, keep, largest, lines.plain[of_plain])
    wavefronts = memory.commands[LEFT : LEFT + 2]
    wavefronts[:] = 0.0
    add_products(matrices.phase, memory.slopes[LEFT_LEARNT : LEFT_PLAIN + 1], wavefronts)
    learnt, plain = 0.0, 0.0
    for c in range(wavefronts.shape[1]):
        learnt += wavefronts[0, c] * wavefronts[0, c]
        plain += wavefronts[1, c] * wavefronts[1, c]
    was_chosen = guard.chosen
    choose(memory.guard, learnt, plain)
    if guard.chosen > was_chosen and guard.excess[RESIDUAL] > MOST_EXCESS:
        _adopt(lines, next_rows)
        guard.sent, guard.blended = INTEGRATOR, 0
    _advance(matrices, memory)
    return total


@_compiled
def _adopt(lines: Lines, next_rows: Rows) -> None:
    """Let the integrator continue from the mirror's commands; the row of its own is not yet sent."""
    row, _, of_plain = next_rows
    length = lines.true.shape[0]
    for later in range(length):
        to, of = (of_plain + 1 + later) % length, (row + later) % length
        for c in range(lines.true.shape[1]):
            lines.plain[to, c] = lines.true[of, c]


@_compiled
def replay(
    recorded: tuple[Array, Array, Array, Array],
    numbers: Numbers,
    matrices: Matrices,
    line: Array,
    memory: Memory,
    squares: Array,
) -> None:
    """Write the squared residual that the filter alone would have left in each recorded frame.

    Parameters
    ----------
    recorded : tuple
        Open-loop slopes, their variance, covariance of x and y, and trust; see `OpenLoopTelemetry`.
    numbers, matrices
        As for `follow`.
    line : (delay + 1, commands) float64 array
        Zeros.
    memory : Memory
    squares : (frames,) float64 array
        Infinite from the first command on that is not finite.
    """
    open_loop, variance, covariance, trust = recorded
    _, _, largest, steps = numbers
    rows, delay = memory.slopes, line.shape[0] - 1
    squares[:] = math.inf
    for frame in range(open_loop.shape[0]):
        row = frame % (delay + 1)
        acting = (row + 1) % (delay + 1)
        rows[HELD] = 0.0
        add_products(matrices.interaction, line[acting : acting + 1], rows[HELD : HELD + 1])
        for s in range(rows.shape[1]):
            measured = variance[frame, s] < LARGEST_VARIANCE_PX2
            rows[LEFT_LEARNT, s] = trust[frame, s] * (open_loop[frame, s] + rows[HELD, s])
            rows[VARIANCE, s] = variance[frame, s] if measured else math.inf
            rows[INNOVATION, s] = open_loop[frame, s] - rows[PREDICTED, s] if measured else 0.0
        _correlate(covariance[frame], 1.0, rows)
        wavefront, square = memory.commands[LEFT : LEFT + 1], 0.0
        wavefront[:] = 0.0
        add_products(matrices.phase, rows[LEFT_LEARNT : LEFT_LEARNT + 1], wavefront)
        for c in range(wavefront.shape[1]):
            square += wavefront[0, c] * wavefront[0, c]
        if not np.isfinite(_filter(matrices, memory, steps, largest, line[row])):
            return
        squares[frame] = square
        _advance(matrices, memory)


HOLD, FOLLOW, GO_ON = Direct(hold), Direct(follow), Direct(go_on)
