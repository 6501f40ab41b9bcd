"""A question about a closed loop, checked, and how much of the sky has a bright enough star near."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between, numbers_between, one_of
from faintspot.base.config.options import LIST, Options, number
from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.methods import MethodKind, method_kind
from faintspot.loop.control.identification.models import INTEGRATOR, predicts
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import CLOSED
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.window import Window

Floats = NDArray[np.float64]

PLACES = {"galactic pole": 90.0, "latitude 30 degrees": 30.0, "galactic plane": 0.0}
"""Galactic latitudes, degrees; the plane stands for the mean of all within 20 degrees of it."""
MODEL_ERROR = 0.25
"""Relative error of a density, about: 15 % of the formula, and what differs between regions and bands."""

# Bahcall & Soneira 1980 (ApJS 44, 73), appendix B: integrated counts in V of the disk and of the spheroid,
# stars per square degree; for 5 < V < 30 and latitudes above 20 degrees.
_DISK = {"scale": 925.0, "alpha": -0.132, "beta": 0.035, "power": 3.0, "middle": 15.75}
_SPHEROID = {"scale": 1050.0, "alpha": -0.18, "beta": 0.087, "power": 2.5, "middle": 17.5}
_LOWEST_LATITUDE_DEG = 20.0
# Stars per square degree of the whole sky brighter than magnitude 5 to 16: Tycho-2 (Hog et al. 2000) and
# UCAC4 (Zacharias et al. 2013). Beyond, as the slope of the last magnitudes says.
_MEAN_MAGNITUDES = np.arange(5.0, 17.0)
_MEAN_DENSITIES = np.array(
    [0.0423, 0.129, 0.400, 1.177, 3.379, 9.282, 25.41, 71.65, 178.1, 417.3, 954.8, 2154.9]
)
_BRIGHTEST, _FAINTEST = 5.0, 21.0
# V of a K0 dwarf, a typical star of these counts, less its magnitude in a band (Bessell & Brett 1988, PASP
# 100, 1134; Bessell 1979).
_V_MINUS = {"B": -0.81, "V": 0.0, "R": 0.45, "I": 0.85, "J": 1.45, "H": 1.85, "K": 1.95}


def star_density(magnitude: ArrayLike, latitude_deg: float, band: str = "V") -> Floats:
    """Return the number of stars per square degree that are brighter than a magnitude.

    Bahcall & Soneira's (1980) model, averaged over galactic longitude; within 20 degrees of the plane, where
    it does not hold, what catalogues' counts of the whole sky leave for there. See `MODEL_ERROR`.

    Parameters
    ----------
    magnitude : array
        5 to 21 in V.
    latitude_deg : float
        Galactic latitude, -90 to 90.
    band : str
        B, V, R, I, J, H or K; others than V by the colour of a K0 dwarf.

    Returns
    -------
    array of the same shape

    Raises
    ------
    InputError
        For an unknown band, or values out of range.
    """
    latitude = abs(number_between("latitude_deg", latitude_deg, -90.0, 90.0))
    colour = _V_MINUS[one_of("band", band, tuple(_V_MINUS))]
    visual = numbers_between("magnitude", magnitude, *known_magnitudes(band)) + colour
    if latitude >= _LOWEST_LATITUDE_DEG:
        return _averaged(visual, latitude)
    above = math.sin(math.radians(_LOWEST_LATITUDE_DEG))  # the fraction of the sky that is below
    sines = (np.arange(8) + 0.5) / 8 * (1 - above) + above
    away = np.mean([_averaged(visual, math.degrees(math.asin(sine))) for sine in sines], axis=0)
    slope = math.log(_MEAN_DENSITIES[-1] / _MEAN_DENSITIES[-2])
    within = np.interp(visual, _MEAN_MAGNITUDES, np.log(_MEAN_DENSITIES))
    mean = np.exp(within + slope * np.maximum(visual - _MEAN_MAGNITUDES[-1], 0.0))
    density: Floats = np.maximum((mean - (1 - above) * away) / above, away)
    return density


def known_magnitudes(band: str = "V") -> tuple[float, float]:
    """Return the brightest and the faintest magnitude that `star_density` knows."""
    colour = _V_MINUS[one_of("band", band, tuple(_V_MINUS))]
    return _BRIGHTEST - colour, _FAINTEST - colour


def sky_coverage(magnitude: ArrayLike, radius_arcsec: float, latitude_deg: float, band: str = "V") -> Floats:
    """Return the fraction of the sky with a bright enough star within a radius: 1 - exp(-n pi r^2).

    Parameters
    ----------
    magnitude, latitude_deg, band
        See `star_density`.
    radius_arcsec : float
        How far from the target a star still serves, such as the isoplanatic angle.

    Raises
    ------
    InputError
        As `star_density`.
    """
    radius = number_between("radius_arcsec", radius_arcsec, 0.0, 3600.0, low_open=True) / 3600.0
    return -np.expm1(-star_density(magnitude, latitude_deg, band) * math.pi * radius**2)


def isoplanatic_angle_arcsec(configuration: LoopConfiguration) -> float:
    """Return 0.314 r0 / h at the science wavelength (Fried 1982, JOSA 72, 52), r0 at its mean.

    h is the layers' altitude, averaged with power 5/3 and their strength.

    Raises
    ------
    InputError
        When all turbulence is on the ground.
    """
    atmosphere = configuration.atmosphere
    strength = np.array(atmosphere.fraction) / np.sum(atmosphere.fraction)
    altitude = float((strength @ np.array(atmosphere.altitude_m) ** (5 / 3)) ** 0.6)
    if altitude <= 0:
        raise InputError("atmosphere.altitude_m: expected a layer above the ground for an isoplanatic angle")
    r0 = float(np.mean(atmosphere.r0_m)) * (configuration.science.wavelength_m / 500e-9) ** 1.2
    return math.degrees(0.314 * r0 / altitude) * 3600.0


def _averaged(visual: Floats, latitude_deg: float) -> Floats:
    """Return the model's density, averaged over longitude."""
    longitudes = np.radians(np.arange(15.0, 360.0, 30.0))
    latitude = math.radians(latitude_deg)
    return np.asarray(np.mean([_model(visual, latitude, longitude) for longitude in longitudes], axis=0))


def _model(visual: Floats, latitude: float, longitude: float) -> Floats:
    """Return the formula's density in one direction (radians)."""
    beyond = np.clip(visual, 12.0, 20.0) - 12.0
    tilt, gamma = 0.03 + 0.0075 * beyond, 0.36 - 0.04 * beyond
    towards = math.cos(longitude)
    path = math.sin(latitude) * (1.0 - tilt / math.tan(latitude) * towards)
    centre = math.cos(latitude) * towards
    disk = _counts(visual, **_DISK) / path ** (3.0 - 5.0 * gamma)
    spheroid: Floats = _counts(visual, **_SPHEROID) / (1.0 - centre) ** (1.45 - 0.2 * centre)
    return disk + spheroid


def _counts(visual: Floats, scale: float, alpha: float, beta: float, power: float, middle: float) -> Floats:
    away = visual - middle
    counts: Floats = scale * 10.0 ** (beta * away) / (1.0 + 10.0 ** (alpha * away)) ** power
    return counts


REFERENCES = BASELINE, SECOND = Window.name, BrightestPixels.name
"""Baselines of every gain, first and second, both with the integrator."""
_CANDIDATES = (SECOND, BASELINE, "map_predicted", "window+kalman", "map+kalman")
_FAINTER = 4.0  # than the faintest star of the configuration: limiting magnitudes are there
_AROUND = (1 / 8, 4.0)  # of the star's flux, where the configuration has no other stars
_LEAST_PHOTONS = 0.5


@dataclass(frozen=True, eq=False)
class LoopQuestion(Options):
    """A closed loop, and the stars to answer for.

    Parameters
    ----------
    configuration : LoopConfiguration
        Telescope, sensor, camera, air and control; its flux is that of the star.
    magnitudes : (float, float), optional
        First and last magnitude. Default: from the brightest star of the configuration's `run` to one four
        times fainter than the faintest; without any, from four times the star's flux to an eighth.
    methods : sequence of str, optional
        Names of candidates as for `method_kind`; "window" and "brightest" always take part. Default: those,
        "map_predicted", and with the predictive Kalman filter "window+kalman" and "map+kalman".
    strehl : float, optional
        Strehl ratio that limiting magnitudes are for. Default: half of what the baseline has with the
        brightest star.
    radius_arcsec : float, optional
        How far from the target a star still serves. Default: the isoplanatic angle of the layers.

    Raises
    ------
    InputError
        For values out of range, unknown methods, control that learns in open loop.

    Examples
    --------
    >>> from faintspot.loop.simulation import load_loop
    >>> from faintspot.experiments import LoopQuestion
    >>> question = LoopQuestion(load_loop("canary"), magnitudes=(10.0, 13.0), methods=["window", "map"])
    >>> [round(photons) for photons in question.photons(3)]
    [35, 139, 300]
    """

    configuration: LoopConfiguration
    magnitudes: Sequence[float] | None = number(None, -30.0, 60.0, kind=LIST)
    methods: Sequence[str] | None = None
    strehl: float | None = number(None, 0.0, 1.0, low_open=True)
    radius_arcsec: float | None = number(None, 0.0, 3600.0, low_open=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        loop: object = self.configuration
        if not isinstance(loop, LoopConfiguration):
            got = type(loop).__name__
            raise InputError(
                f"configuration: expected a faintspot.loop.simulation.LoopConfiguration, got {got}"
            )
        ends = self.magnitudes
        if ends is not None and (len(ends) != 2 or ends[0] == ends[1]):
            raise InputError(f"expected a first and another last one, got {list(ends)}", name="magnitudes")
        for kind in self.kinds:
            if kind.control != INTEGRATOR and self.configuration.control.mode != CLOSED:
                raise InputError(f"methods: {kind.name!r} learns from a closed loop, this one is open")

    @property
    def kinds(self) -> tuple[MethodKind, ...]:
        """Candidates: those with the integrator first, also that of each one whose control learns."""
        names = (SECOND, BASELINE, *(self._default() if self.methods is None else self.methods))
        kinds = {kind.name: kind for kind in map(method_kind, names)}
        plain = [replace(kind, control=INTEGRATOR) for kind in kinds.values()]
        learning = [kind for kind in kinds.values() if kind.control != INTEGRATOR]
        return tuple({kind.name: kind for kind in [*plain, *learning]}.values())

    @property
    def left_out(self) -> dict[str, str]:
        """Default candidates that do not suit, and why."""
        if self.methods is not None or self.configuration.control.mode == CLOSED:
            return {}
        reason = "its control learns from a closed loop, this one is open"
        return {name: reason for name in _CANDIDATES if predicts(method_kind(name).control)}

    def _default(self) -> list[str]:
        return [name for name in _CANDIDATES if name not in self.left_out]

    def photons(self, count: int) -> tuple[float, ...]:
        """Return the fluxes to measure at, rising: evenly spread magnitudes, one of them moved to the star.

        Photo-electrons of a fully lit sub-aperture in a frame, to four digits.
        """
        low, high = self._ends()
        fluxes = np.geomspace(low, high, count)
        star = self.configuration.photons
        if low <= star <= high:
            fluxes[np.argmin(np.abs(np.log(fluxes / star)))] = star
        return tuple(float(f"{flux:.4g}") for flux in fluxes)

    def _ends(self) -> tuple[float, float]:
        loop = self.configuration
        if self.magnitudes is not None:
            ends = loop.photometry.electrons(np.asarray(self.magnitudes, np.float64))
        elif loop.run.photons_per_subaperture:
            stars = (loop.photons, *loop.run.photons_per_subaperture)
            ends = np.array([min(loop.photons, min(stars) / _FAINTER), max(stars)])
        else:
            ends = loop.photons * np.array(_AROUND)
        low, high = float(ends.min()), float(ends.max())
        if high <= _LEAST_PHOTONS:
            raise InputError(
                f"magnitudes: expected some that leave above {_LEAST_PHOTONS:g} photo-electrons in a "
                f"sub-aperture, the brightest leaves {high:.3g}"
            )
        return max(low, _LEAST_PHOTONS), high

    @property
    def radius(self) -> float | None:
        """Largest useful distance of a star from the target, arcsec; None: no high turbulence."""
        if self.radius_arcsec is not None:
            return float(self.radius_arcsec)
        atmosphere = self.configuration.atmosphere
        if not np.dot(atmosphere.altitude_m, atmosphere.fraction) > 0:
            return None
        return min(isoplanatic_angle_arcsec(self.configuration), 3600.0)


def magnitudes_apart(photons: Sequence[float]) -> float:
    """Return the largest step between neighbouring fluxes, magnitudes."""
    return float(2.5 / math.log(10) * np.diff(np.log(photons)).max())
