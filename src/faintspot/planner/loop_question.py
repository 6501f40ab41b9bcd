"""What the user knows of a closed loop and wants to know of it, checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import number_between, numbers_between
from faintspot.control.learning import INTEGRATOR, KALMAN
from faintspot.errors import InputError
from faintspot.loop.arm_kinds import ArmKind, arm_kind
from faintspot.loop.configuration import CLOSED, LoopConfiguration
from faintspot.planner.sky import isoplanatic_angle_arcsec

Floats = NDArray[np.float64]

BASELINE, SECOND = "window", "brightest"
"""What every gain is stated against, first and second: both with the integrator."""
_CANDIDATES = (SECOND, BASELINE, "map_predicted", "window+kalman", "map+kalman")
_FAINTER = 4.0  # than the faintest star of the configuration: limiting magnitudes are there
_AROUND = (1 / 8, 4.0)  # of the star's light, where the configuration has no other stars
_LEAST_PHOTONS = 0.5


@dataclass(frozen=True, eq=False)
class LoopQuestion:
    """A closed loop, and the stars that it shall be told for.

    Parameters
    ----------
    configuration : LoopConfiguration
        Telescope, sensor, camera, air and control; its light is that of the star.
    magnitudes : (float, float), optional
        First and last magnitude. Default: from the brightest star of the configuration's `run` to one four
        times fainter than the faintest; without any, from four times the star's light to an eighth.
    arms : sequence of str, optional
        Names of candidates as for `arm_kind`; "window" and "brightest" always take part. Default: those,
        "map_predicted", and with the predictive Kalman filter "window+kalman" and "map+kalman" as far as the
        time goes.
    strehl : float, optional
        Strehl ratio that limiting magnitudes are for. Default: half of what the baseline has with the
        brightest star.
    radius_arcsec : float, optional
        How far from the target a star still serves. Default: the isoplanatic angle of the layers.
    minutes : float
        Time after which no further candidate of the default ones is begun.

    Raises
    ------
    InputError
        For values out of range, unknown arms, control that learns in open loop.

    Examples
    --------
    >>> from faintspot.loop import load_loop
    >>> from faintspot.planner import LoopQuestion
    >>> question = LoopQuestion(load_loop("canary"), magnitudes=(10.0, 13.0), arms=["window", "map"])
    >>> [round(photons) for photons in question.photons(3)]
    [35, 139, 300]
    """

    configuration: LoopConfiguration
    magnitudes: Sequence[float] | None = None
    arms: Sequence[str] | None = None
    strehl: float | None = None
    radius_arcsec: float | None = None
    minutes: float = 5.0

    def __post_init__(self) -> None:
        loop: Any = self.configuration
        if not isinstance(loop, LoopConfiguration):
            got = type(loop).__name__
            raise InputError(f"configuration: expected a faintspot.loop.LoopConfiguration, got {got}")
        if self.magnitudes is not None:
            ends = numbers_between("magnitudes", self.magnitudes, -30.0, 60.0)
            if ends.shape != (2,) or ends[0] == ends[1]:
                raise InputError(f"magnitudes: expected a first and another last one, got {ends.tolist()}")
        if self.strehl is not None:
            number_between("strehl", self.strehl, 0.0, 1.0, low_open=True)
        if self.radius_arcsec is not None:
            number_between("radius_arcsec", self.radius_arcsec, 0.0, 3600.0, low_open=True)
        number_between("minutes", self.minutes, 0.0, low_open=True)
        for kind in self.kinds:
            if kind.control != INTEGRATOR and self.configuration.control.mode != CLOSED:
                raise InputError(f"arms: {kind.name!r} learns from a closed loop, this one is open")

    @property
    def kinds(self) -> tuple[ArmKind, ...]:
        """Candidates: those with the integrator first, also that of each one whose control learns."""
        names = (SECOND, BASELINE, *(self._default() if self.arms is None else self.arms))
        asked = {kind.name: kind for kind in map(arm_kind, names)}
        plain = [replace(kind, control=INTEGRATOR) for kind in asked.values()]
        learning = [kind for kind in asked.values() if kind.control != INTEGRATOR]
        return tuple({kind.name: kind for kind in [*plain, *learning]}.values())

    @property
    def left_out(self) -> dict[str, str]:
        """Default candidates that do not suit, and why."""
        if self.arms is not None:
            return {}
        reasons = {}
        for name in _CANDIDATES:
            kind = arm_kind(name)
            if kind.control == KALMAN and self.configuration.control.mode != CLOSED:
                reasons[name] = "its control learns from a closed loop, this one is open"
        return reasons

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
        """How far from the target a star still serves, arcsec; None: all turbulence is on the ground."""
        if self.radius_arcsec is not None:
            return float(self.radius_arcsec)
        if not any(self._layers_above()):
            return None
        return min(isoplanatic_angle_arcsec(self.configuration), 3600.0)

    def _layers_above(self) -> list[Any]:
        air = self.configuration.atmosphere
        return [h > 0 and part > 0 for h, part in zip(air.altitude_m, air.fraction, strict=True)]


def magnitudes_apart(photons: Sequence[float]) -> float:
    """Return the largest step between neighbouring fluxes, magnitudes."""
    return float(2.5 / math.log(10) * np.diff(np.log(photons)).max())
