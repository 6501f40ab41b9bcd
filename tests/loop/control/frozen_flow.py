"""Slopes of frozen turbulence, an oracle that shares nothing with the theory; loops closed on such slopes."""

import numpy as np

from faintspot.loop.slope_covariance import SlopeTurbulence
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M, SPECTRUM

WAVES = 1500


def frozen_slopes(air: SlopeTurbulence, frames: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    """Return slopes (frames, 2 n) px.

    Wave numbers are drawn evenly in their logarithm, and each wave is as strong as the spectrum around it.
    """
    time = np.arange(frames) / rate_hz
    total = np.zeros((frames, 2 * len(air.positions_m)))
    low, high = np.log(0.02 / air.outer_scale_m), np.log(4.0 / air.subaperture_m)
    shares, side_m = air.fraction / air.fraction.sum(), air.averaged * air.subaperture_m
    for share, wind in zip(shares, air.wind_m_per_s, strict=True):
        size = np.exp(rng.uniform(low, high, WAVES))
        angle = rng.uniform(0, 2 * np.pi, WAVES)
        wave = size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        power = SPECTRUM * air.r0_m ** (-5 / 3) * (size**2 + air.outer_scale_m**-2) ** (-11 / 6)
        variance = share * power * 2 * np.pi * size**2 * (high - low) / WAVES  # rad^2 of each wave
        strength = np.sqrt(variance) * np.sinc(wave * side_m).prod(axis=1)
        moved = 2 * np.pi * np.outer(time, wave @ wind)
        place = 2 * np.pi * air.positions_m @ wave.T
        one, other = rng.standard_normal((2, WAVES)) * strength
        rise = 2 * np.pi * np.repeat(wave, len(place), axis=1)  # of x slopes, then of y slopes
        cosine, sine = (np.tile(each(place).T, 2) * rise for each in (np.cos, np.sin))
        total += np.cos(moved) @ (other[:, None] * cosine + one[:, None] * sine)
        total += np.sin(moved) @ (other[:, None] * sine - one[:, None] * cosine)
    return np.asarray(total * (R0_WAVELENGTH_M / (2 * np.pi) / air.pixel_scale_rad))


def closed_loop(
    open_loop: np.ndarray,
    noise: np.ndarray,
    matrix: np.ndarray,
    inverse: np.ndarray,
    *,
    delay: int = 2,
    loop_gain: float = 0.3,
    seen: float | np.ndarray = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes and commands of an integrator with a leak of 1 %, whose sensor has the gain `seen`."""
    slopes, commands = np.zeros_like(open_loop), np.zeros((len(open_loop) + delay, matrix.shape[1]))
    for frame, turbulence in enumerate(open_loop):
        slopes[frame] = seen * (turbulence + matrix @ commands[frame]) + noise[frame]
        before = commands[frame + delay - 1]
        commands[frame + delay] = 0.99 * before - loop_gain * inverse @ slopes[frame]
    return slopes, commands[delay:]
