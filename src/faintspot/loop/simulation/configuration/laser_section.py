"""Tables [laser] and [natural_star] of a loop's configuration."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.config.options import LIST, number
from faintspot.base.config.tables import ConfigurationTable
from faintspot.base.errors import InputError
from faintspot.slopes.spots.sodium import SodiumProfile, integration_points

_STEPS = 8  # between two altitudes


@dataclass(frozen=True)
class Laser(ConfigurationTable, table="laser"):
    """Laser guide star: the sensor's spots are images of a sodium layer that changes with time.

    Raises
    ------
    InputError
        If lists have other lengths, altitudes or times do not increase, or a density is negative.
    """

    launch_m: tuple[float, ...] = number((0.0, 0.0), -1e3, 1e3, kind=LIST)
    """x and y of the launch telescope, from the centre of the pupil."""
    spot_fwhm_arcsec: float = number(1.0, 0.05, 60.0)
    """Full width at half maximum of the beam at a single altitude, without the turbulence on its way down."""
    jitter_arcsec: float = number(0.0, 0.0, 10.0)
    """Rms of the motion of all spots by the beam, on each axis, independent from frame to frame."""
    zenith_distance_deg: float = number(0.0, 0.0, 75.0)
    site_altitude_m: float = number(0.0, -500.0, 1e4)
    altitude_m: tuple[float, ...] = number((80e3, 85e3, 90e3, 95e3, 100e3), 0.0, 1e6, kind=LIST)
    """Altitudes of the sodium profile above sea level; the sensor is focused on the first profile."""
    time_s: tuple[float, ...] = number((0.0,), 0.0, 1e6, kind=LIST)
    """Times of the profiles, increasing; between them the profile is interpolated."""
    density: tuple[tuple[float, ...], ...] = field(default=((0.0, 0.5, 1.0, 0.5, 0.0),))
    """Density at each altitude, in any unit: a list for each time."""
    learn_frames: int = number(2000, 1, 1_000_000, whole=True)
    """Frames before a run from whose mean the profile is learnt."""
    follow_every_frames: int = number(100, 1, 1_000_000, whole=True)
    """Frames between two fits of the profile, for methods that follow it."""
    follow_time_constant_frames: float = number(400.0, 1.0, 1e9)
    """Time constant of the running mean images that it is fitted to."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.launch_m) != 2:
            raise InputError(f"laser.launch_m: expected x and y, got {list(self.launch_m)}")
        rows = tuple(np.ravel(row) for row in self.density) if np.ndim(self.density) else ()
        if len(rows) != len(self.time_s) or not rows or {len(row) for row in rows} != {len(self.altitude_m)}:
            shape, lengths = (len(self.time_s), len(self.altitude_m)), [len(row) for row in rows]
            raise InputError(f"laser.density: expected (times, altitudes) = {shape}, got rows of {lengths}")
        values = numbers_between("laser.density", rows, 0.0)
        if np.any(np.diff(self.time_s) <= 0):
            raise InputError(f"laser.time_s: expected increasing times, got {list(self.time_s)}")
        number_between("laser.altitude_m[0]", self.altitude_m[0], self.site_altitude_m + 1e3)
        for row in values:
            SodiumProfile(self.altitude_m, row)
        density: object = tuple(map(tuple, values.tolist()))
        object.__setattr__(self, "density", density)

    @property
    def focus_altitude_m(self) -> float:
        """Altitude that the sensor is focused on: that of the mean inverse distance of the first profile."""
        profile = self.profiles()[0]
        points, parts = integration_points(profile.altitudes_m, _STEPS)
        inverse = (parts @ profile.density) @ (1.0 / (points - self.site_altitude_m))
        return float(1.0 / inverse) + self.site_altitude_m

    def profiles(self) -> list[SodiumProfile]:
        """Return the profile at each time."""
        return [SodiumProfile(self.altitude_m, row) for row in self.density]

    def shares(self, time_s: float) -> list[tuple[int, float]]:
        """Return number and share of the profiles, one or two, that make up that of a time."""
        after = int(np.searchsorted(self.time_s, time_s, side="right"))
        if after in (0, len(self.time_s)):
            return [(max(after - 1, 0), 1.0)]
        before = after - 1
        part = (time_s - self.time_s[before]) / (self.time_s[after] - self.time_s[before])
        return [(before, 1.0 - part), (after, part)] if part > 0 else [(before, 1.0)]


@dataclass(frozen=True)
class NaturalStar(ConfigurationTable, table="natural_star"):
    """Natural star for tip, tilt and slow focus beside a laser guide star.

    Its sensor sees the mean gradients over the quadrants of the pupil after the mirror, with photon noise.
    """

    photons: float = number(1000.0, 0.0, 1e12, low_open=True)
    """Photo-electrons of the whole pupil in one exposure of the laser's sensor."""
    fwhm_arcsec: float = number(0.8, 0.01, 60.0)
    """Width of the star's image, on which its noise depends."""
    tip_tilt_frames: int = number(1, 1, 100_000, whole=True)
    """Frames of the laser's sensor in one measurement of tip and tilt."""
    focus_frames: int = number(25, 1, 100_000, whole=True)
    """Frames of the laser's sensor in one measurement of focus."""
    focus_gain: float = number(0.3, 0.0, 1.0)
    """Part of a measured focus by which the laser's reference is corrected."""
