"""Optimal gain of each mode from recorded open-loop slopes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GAINS = np.array([0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.27, 0.35, 0.43, 0.52, 0.62, 0.73, 0.85])


def modal_gains(modes: Floats, delay_frames: int, leak: float, gains: Floats = GAINS) -> Floats:
    """Return the best gain of an integrator for each mode (Gendron & Lena 1994, A&A 291, 337).

    What a mode's spectrum leaves behind the integrator's rejection is summed over all frequencies, for every
    gain. The noise of the open-loop modes may stay in them: a command does not know the noise of the frame
    that it acts in, so that this noise adds the same at every gain.

    Parameters
    ----------
    modes : (frames, modes) array
        Open-loop amplitude of each mode, with its noise.
    delay_frames : int
    leak : float
        Part of the command that is forgotten in every frame.
    gains : array
        Those to choose from; those that make the loop unstable are not considered.
    """
    frames = len(modes)
    spectrum = np.square(np.abs(np.fft.rfft(modes * np.hanning(frames)[:, None], axis=0)))
    z = np.exp(-2j * np.pi * np.fft.rfftfreq(frames))
    stable = gains[gains < largest_stable_gain(delay_frames)]
    integrated = z**delay_frames / (1 - (1 - leak) * z + 1e-12)
    rejected = 1 / np.square(np.abs(1 + stable[:, None] * integrated))
    return np.asarray(stable[np.argmin(rejected @ spectrum, axis=0)])


def largest_stable_gain(delay_frames: int) -> float:
    """Return the smallest gain at which an integrator without leak is unstable."""
    return float(2 * np.sin(np.pi / (2 * (2 * delay_frames - 1))))
