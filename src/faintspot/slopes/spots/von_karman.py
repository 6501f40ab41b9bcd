"""Von Karman model of atmospheric turbulence: structure function and power spectrum of the phase."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

R0_WAVELENGTH_M = 500e-9
"""Wavelength at which the Fried parameter r0 is given."""
SPECTRUM = 0.0229
"""Coefficient of the power spectral density of the phase, SPECTRUM r0^(-5/3) (f^2 + 1 / L0^2)^(-11/6)."""


def structure_function(separation: Floats, outer_scale: float) -> Floats:
    """Return the phase structure function [rad^2] for r0 = 1; infinite outer scale: Kolmogorov.

    D(r) = 6.88 r^(5/3) (Fried 1966, JOSA 56, 1372), or with an outer scale D(r) = 2 (B(0) - B(r)) with B(r)
    proportional to L0^(5/3) (2 pi r / L0)^(5/6) K_5/6(2 pi r / L0) (Conan 2008, JOSA A 25, 526).

    Parameters
    ----------
    separation : array
        Separation in units of r0.
    outer_scale : float
        L0 in units of r0.
    """
    from scipy.special import gamma, kv  # imported here: it takes 0.1 s and is not needed for slopes

    if math.isinf(outer_scale):
        kolmogorov: Floats = 6.88 * separation ** (5 / 3)
        return kolmogorov
    t = 2 * np.pi * np.maximum(separation, 1e-12) / outer_scale
    factor = gamma(11 / 6) / (2 ** (5 / 6) * np.pi ** (8 / 3)) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    at_zero = 2 ** (-1 / 6) * gamma(5 / 6)
    von_karman: Floats = 2 * factor * outer_scale ** (5 / 3) * (at_zero - t ** (5 / 6) * kv(5 / 6, t))
    return von_karman
