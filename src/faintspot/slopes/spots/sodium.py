"""Vertical profile of the sodium layer, from which a laser guide star's light returns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.files import NpzFile
from faintspot.base.statistics import FWHM_TO_STD

_HIGHEST_M = 1e6
_MOST_BINS = 4096
_STEPS = 4  # points between two altitudes, for moments
_REACH = 1.5  # FWHM from the middle of a layer to the end of its table


@dataclass(frozen=True, eq=False)
class SodiumProfile(NpzFile):
    """Return flux of the sodium layer against altitude; linear between its altitudes, immutable.

    The density of sodium atoms divided by the squared distance to the telescope, if that matters. The
    integral over the altitude is normalised to 1: the flux is not part of the profile.

    Parameters
    ----------
    altitudes_m : (n,) array
        Altitudes above sea level [m], increasing, at least 2.
    density : (n,) array
        Return flux per metre of altitude, not negative, in any unit.

    Raises
    ------
    InputError
        If altitudes do not increase, densities are negative or all zero, or shapes differ.

    Examples
    --------
    >>> import faintspot as fs
    >>> profile = fs.SodiumProfile.gaussian(mean_m=90e3, fwhm_m=10e3)
    >>> print(f"{profile.mean_m:.0f} m, standard deviation {profile.std_m:.0f} m")
    90000 m, standard deviation 4246 m
    """

    WHAT = "a sodium profile"
    FIELDS = ("altitudes_m", "density")

    altitudes_m: Any
    density: Any

    def __post_init__(self) -> None:
        altitudes = numbers_between("profile.altitudes_m", self.altitudes_m, 0.0, _HIGHEST_M)
        density = numbers_between("profile.density", self.density, 0.0)
        if altitudes.ndim != 1 or not 2 <= len(altitudes) <= _MOST_BINS:
            raise InputError(
                f"profile.altitudes_m: expected 2 to {_MOST_BINS} altitudes, got shape {altitudes.shape}"
            )
        if np.any(np.diff(altitudes) <= 0):
            raise InputError("profile.altitudes_m: expected increasing altitudes, got others")
        check_shape("profile.density", density, altitudes.shape)
        density = density / max(density.max(), np.finfo(float).tiny)
        total = float(np.trapezoid(density, altitudes))
        if not total > 0:
            raise InputError("profile.density: expected a positive density, got none")
        for name, values in (("altitudes_m", altitudes), ("density", density / total)):
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @classmethod
    def gaussian(cls, mean_m: float = 90e3, fwhm_m: float = 10e3, *, bins: int = 41) -> SodiumProfile:
        """Return a Gaussian layer, out to 1.5 times its full width at half maximum on either side."""
        return cls.peaks([mean_m], [fwhm_m], [1.0], bins=bins)

    @classmethod
    def peaks(cls, means_m: object, fwhms_m: object, fractions: object, *, bins: int = 41) -> SodiumProfile:
        """Return the sum of several Gaussian layers.

        Parameters
        ----------
        means_m, fwhms_m, fractions : (n_layers,) array
            Mean altitude [m], full width at half maximum [m] and relative flux of each layer.
        bins : int
            Number of altitudes.

        Raises
        ------
        InputError
            If a value is out of range, or shapes differ.
        """
        means = numbers_between("means_m", means_m, 0.0, _HIGHEST_M, low_open=True)
        widths = numbers_between("fwhms_m", fwhms_m, 0.0, _HIGHEST_M, low_open=True)
        flux = numbers_between("fractions", fractions, 0.0)
        count = int(number_between("bins", bins, 2, _MOST_BINS, integer=True))
        if means.ndim != 1 or widths.shape != means.shape or flux.shape != means.shape:
            raise InputError(
                "means_m, fwhms_m, fractions: expected one number per layer, "
                f"got shapes {means.shape}, {widths.shape} and {flux.shape}"
            )
        low, high = (means - _REACH * widths).min(), (means + _REACH * widths).max()
        altitudes = np.linspace(max(low, 0.0), high, count)
        std = FWHM_TO_STD * widths
        layers = flux / std * np.exp(-0.5 * ((altitudes[:, None] - means) / std) ** 2)
        return cls(altitudes, layers.sum(axis=1))

    def __repr__(self) -> str:
        """Return mean and standard deviation instead of the table."""
        mean, std = self.mean_m / 1e3, self.std_m / 1e3
        return f"SodiumProfile(mean {mean:.4g} km, std {std:.3g} km, {len(self.density)} altitudes)"

    def at(self, altitudes_m: Any) -> SodiumProfile:
        """Return the profile on other altitudes, between which it is linear.

        Raises
        ------
        InputError
            If they do not increase or are outside the profile.
        """
        return SodiumProfile(altitudes_m, np.interp(altitudes_m, self.altitudes_m, self.density, 0.0, 0.0))

    @property
    def mean_m(self) -> float:
        """Mean altitude above sea level [m]."""
        altitudes, parts = integration_points(self.altitudes_m, _STEPS)
        return float(altitudes @ parts @ self.density)

    @property
    def std_m(self) -> float:
        """Standard deviation of the altitudes [m]."""
        altitudes, parts = integration_points(self.altitudes_m, _STEPS)
        return math.sqrt(float(np.square(altitudes - self.mean_m) @ parts @ self.density))


def integration_points(altitudes_m: Floats, steps: int) -> tuple[Floats, Floats]:
    """Return points between altitudes, and the flux at each for a density of 1 at each altitude.

    Parameters
    ----------
    altitudes_m : (n,) array
    steps : int
        Points in an interval.

    Returns
    -------
    points : (n - 1) * steps array
        Altitudes [m].
    parts : ((n - 1) * steps, n) array
        Flux, for a density that is linear between the altitudes [m].
    """
    widths = np.diff(altitudes_m)[:, None]
    fraction = (np.arange(steps) + 0.5) / steps
    points = altitudes_m[:-1, None] + widths * fraction
    parts = np.zeros((len(widths), steps, len(altitudes_m)))
    interval = np.arange(len(widths))
    parts[interval, :, interval] = widths * (1.0 - fraction) / steps
    parts[interval, :, interval + 1] = widths * fraction / steps
    return points.ravel(), parts.reshape(points.size, -1)
