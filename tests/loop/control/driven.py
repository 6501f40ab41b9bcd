"""Oscillators driven by white noise."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from faintspot.loop.control.identification.vibrations import Vibration


def oscillator(frequency_hz: float, damping: float, rms_px: float) -> Vibration:
    return Vibration("tip", frequency_hz, damping, rms_px, 0.0, 0.0)


def driven(
    rng: np.random.Generator, frames: int, rate_hz: float, slopes: int, *every: Vibration
) -> NDArray[np.float64]:
    """Return the sum of amplitudes of oscillators in so many slopes, (frames,)."""
    total = np.zeros(frames)
    for each in every:
        one, two = each.recursion(rate_hz)
        driving = np.sqrt(slopes * each.driving_variance(rate_hz)) * each.rms_px
        noise = driving * rng.standard_normal(frames + 1000)
        total += lfilter([1.0], [1.0, -one, -two], noise)[-frames:]
    return total
