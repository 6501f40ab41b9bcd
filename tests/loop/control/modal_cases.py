"""Simulated loops of sensors without geometry."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.loop.control.driven import driven, oscillator

from faintspot.loop.control.identification.recording import Recording

Floats = NDArray[np.float64]

RATE_HZ, NOISE, LEAK = 500.0, 0.15, 0.01


def wandering(rng: np.random.Generator, frames: int, modes: int = 2) -> Floats:
    """Return amplitudes of unit rms that fall as f^-11/3, and a vibration of 47 Hz, (frames, modes)."""
    frequency = np.fft.rfftfreq(2 * frames, 1 / RATE_HZ)
    amplitude = (0.1 + frequency**2) ** (-1 / 6) * (1 + (frequency / 0.8) ** 2) ** (-3 / 4)
    amplitude[0] = 0.0
    phases = rng.standard_normal((2, len(frequency), modes))
    slow = np.fft.irfft(amplitude[:, None] * (phases[0] + 1j * phases[1]), axis=0)[:frames]
    lines = [driven(rng, frames, RATE_HZ, 1, oscillator(47.0, 0.005, 0.15)) for _ in range(modes)]
    return np.asarray(slow / slow.std(axis=0) + np.array(lines).T)


def integrated(
    open_loop: Floats,
    rng: np.random.Generator,
    *,
    delay: float = 2.0,
    loop_gain: float = 0.4,
    gain: float = 0.8,
    filtered: float = 0.0,
    noise: float = NOISE,
) -> tuple[Floats, Floats]:
    """Return slopes and commands of an integrator, with a matrix that is the identity.

    Parameters
    ----------
    open_loop : (frames, m) array
    rng : numpy.random.Generator
        Of the noise.
    delay : float
        Frames; of a fraction, the mirror moves within the frame.
    loop_gain : float
    gain : float
        Of the slopes.
    filtered : float
        Part of each step that is taken back in the next frame.
    noise : float
        Standard deviation of that of the slopes.
    """
    whole, part = int(delay), delay % 1
    slopes, commands = np.zeros((2, len(open_loop) + whole + 1, open_loop.shape[1]))
    errors = noise * rng.standard_normal(open_loop.shape)
    for k in range(whole + 1, len(slopes)):
        acting = (1 - part) * commands[k - whole] + part * commands[k - whole - 1]
        slopes[k] = gain * (open_loop[k - whole - 1] + acting) + errors[k - whole - 1]
        step = slopes[k] - filtered * slopes[k - 1]
        commands[k] = (1 - LEAK) * commands[k - 1] - loop_gain * step
    return slopes[whole + 1 :], commands[whole + 1 :]


def recorded(slopes: Floats, commands: Floats, matrix: Floats | None = None) -> Recording:
    """Return a recording without geometry."""
    matrix = np.eye(slopes.shape[1]) if matrix is None else matrix
    return Recording(slopes, commands, matrix, None, RATE_HZ)


def commands_of_matrices(file: Mapping[str, Any], slopes: Floats) -> Floats:
    """Return the commands (frames, commands) that exported matrices make of slopes, (frames, m)."""
    state, sent = np.zeros(len(file["state_of_state"])), []
    held = np.zeros((int(file["delay_frames"]), len(file["command_of_state"])))
    for row in slopes:
        inputs = {"state": state, "slopes": row - file["reference_slopes"], "mirror": held[0]}
        command, state = (
            sum(file[f"{name}_of_{key}"] @ values for key, values in inputs.items())
            for name in ("command", "state")
        )
        held = np.vstack([held[1:], command])
        sent.append(command + file["flat_command"])
    return np.array(sent)
