"""Slopes of frozen turbulence as a sum of many plane waves: an oracle that shares nothing with the theory."""

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
