"""Arrays of the guarded Kalman filter that its kernels share."""

from __future__ import annotations

from typing import Any, NamedTuple

# Rows of memory: of slopes, and of commands; the first four are commands and what they add to slopes.
HELD, HELD_LEARNT, HELD_PLAIN, LATEST_PLAIN, LEFT_LEARNT, LEFT_PLAIN, FOR_PLAIN = range(7)
VARIANCE, COVARIANCE, SCALE, INNOVATION, SOLUTION, DIRECTION, IMAGE, SPARE, PREDICTED = range(7, 16)
SLOPE_ROWS = 16
MADE, LEFT, OFFSET = 4, 5, 7
COMMAND_ROWS = 8


class Matrices(NamedTuple):
    """Constant matrices, transposed so that the terms of a sum are adjacent in memory."""

    interaction: Any
    """(commands, m)"""
    reconstruct: object
    """(m, commands)"""
    phase: Any
    """(m, commands)"""
    covariance: Any
    """(m, states): covariance of the errors of slopes and state before a measurement."""
    uncertainty: object
    """(m, m): covariance of the slopes' error."""
    usual_inverse: object
    """(m, m): inverse of the slopes' covariance with their usual noise."""
    usual_variance: Any
    """(m,): diagonal of that covariance."""
    onward: Any
    """(layers, 2 m, m)"""
    command: Any
    """(states, commands): matrix from the state to commands."""


class Lines(NamedTuple):
    """Delayed commands: of the mirror, and of both controllers."""

    true: Any
    """(delay + 1, commands)"""
    learnt: Any
    plain: Any


class Memory(NamedTuple):
    """State that persists between frames, and work arrays."""

    state: Any
    """(layers, 2, m): predicted state of the next frame."""
    guard: Any
    """(GUARD_NUMBERS,)"""
    slopes: Any
    """(SLOPE_ROWS, m)"""
    commands: Any
    """(COMMAND_ROWS, commands)"""


class Frame(NamedTuple):
    """Slopes of a frame, which are finite, and their noise."""

    slopes: Any
    """(m,) float64"""
    errors: Any
    """(m,) float64; infinite: not measured."""
    covariance: Any
    """(m / 2,) float64: covariances of the noise of x and y."""
    prior_std: Any
    """(m,) or (0,) float64: prior of the estimator; none."""
    noise_factor: float
    """Of the errors' variances."""


class Recorded(NamedTuple):
    """Recorded frames; see `OpenLoopTelemetry`."""

    open_loop: Any
    """(frames, m) float64"""
    variance: Any
    """(frames, m) float64"""
    covariance: Any
    """(frames, m / 2) float64"""
    trust: Any
    """(frames, m) float64"""
