"""Sections of the configuration of a loop: telescope, sensor, atmosphere, camera, laser, control, run."""

import math
from dataclasses import dataclass, field

import numpy as np

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.options import FLAG, LIST, NUMBER_OR_LIST, number, setting
from faintspot.base.tables import ConfigurationTable
from faintspot.loop.control.base import LEARNT, WINDS
from faintspot.slopes.simulate.photometry import StarLight
from faintspot.slopes.spots.sodium import SodiumProfile, integration_points

CLOSED, OPEN = "closed", "open"


@dataclass(frozen=True)
class Telescope(ConfigurationTable, table="telescope"):
    """Pupil of the telescope."""

    diameter_m: float = number(4.2, 0.05, 100.0)
    obstruction: float = number(0.29, 0.0, 0.9)
    """Diameter of the central obstruction as a fraction of the pupil's."""


@dataclass(frozen=True)
class SensorParameters(ConfigurationTable, table="sensor"):
    """Shack-Hartmann sensor."""

    subapertures: int = number(7, 1, 200, whole=True)
    """Sub-apertures across the pupil."""
    subaperture_m: float | None = number(None, 0.0, 100.0, low_open=True)
    """Side of a sub-aperture in the pupil. Default: the sub-apertures just cover the pupil."""
    pixels: int = number(16, 4, 64, whole=True)
    """Pixels across a sub-aperture's window."""
    wavelength_m: float = number(650e-9, 1e-7, 1e-4)
    pixel_scale_arcsec: float | None = number(None, 0.0, 100.0, low_open=True)
    """Default: two pixels for lambda / d."""
    least_illumination: float = number(0.5, 0.0, 1.0, low_open=True)
    """Smallest illuminated fraction of a sub-aperture that is used."""
    samples: int = number(12, 4, 128, whole=True)
    """Number of phase points across a sub-aperture."""
    spot_elongation: float = number(1.0, 1.0, 30.0)
    """Full width at half maximum of a spot along x as a multiple of that along y, before the pixels."""


@dataclass(frozen=True)
class Mirror(ConfigurationTable, table="mirror"):
    """Deformable mirror."""

    actuators: int | None = number(None, 2, 201, whole=True)
    """Actuators across the pupil, its edges included. Default: one at each corner of the sub-apertures."""
    crosstalk: float = number(0.15, 0.0, 0.9, low_open=True)
    """Value of an actuator's Gaussian influence function at its neighbour."""
    tip_tilt: bool = setting(True, kind=FLAG)
    """Whether there is a separate tip-tilt mirror."""


@dataclass(frozen=True)
class Atmosphere(ConfigurationTable, table="atmosphere"):
    """Layers of frozen turbulence moved by the wind; the star is on axis, so altitudes do not matter."""

    r0_m: float | tuple[float, float] = number(0.15, 0.01, 1e3, kind=NUMBER_OR_LIST)
    """Fried parameter at 500 nm, or the two values between which it drifts."""
    drift_time_s: float = number(60.0, 0.0, 1e6, low_open=True)
    """Period of the drift."""
    outer_scale_m: float = number(25.0, 0.5, 200.0)
    altitude_m: tuple[float, ...] = number((0.0, 2500.0, 4000.0, 13500.0), 0.0, 1e5, kind=LIST)
    fraction: tuple[float, ...] = number((0.45, 0.25, 0.15, 0.15), 0.0, 1e6, kind=LIST)
    """Relative strength of each layer."""
    wind_speed_m_per_s: tuple[float, ...] = number((6.0, 9.0, 14.0, 22.0), 0.0, 200.0, kind=LIST)
    wind_direction_deg: tuple[float, ...] = number((20.0, 80.0, 150.0, 250.0), -360.0, 360.0, kind=LIST)


@dataclass(frozen=True)
class Camera(StarLight, ConfigurationTable, table="camera"):
    """The sensor's camera and the star's flux on it; as `faintspot.slopes.simulate.Detector`."""

    photons_per_subaperture: float | None = number(None, 0.0, 1e9, low_open=True)
    """Photo-electrons of a fully illuminated sub-aperture in a frame; or give the magnitude."""
    read_noise_e: float = number(0.1, 0.0, 1e6)
    """At the camera's output, after multiplication."""
    em_gain: float = number(1.0, 1.0, 1e5)
    gain_e_per_adu: float = number(1.0, 0.0, 1e6, low_open=True)
    offset_adu: float = number(0.0, -1e6, 1e6)
    bits: int | None = number(None, 1, 32, whole=True)
    background_e: float = number(0.0, 0.0, 1e6)
    dark_e: float = number(0.0, 0.0, 1e6)


@dataclass(frozen=True)
class ControlParameters(ConfigurationTable, table="control"):
    """Control loop."""

    frame_rate_hz: float = number(250.0, 0.0, 1e5, low_open=True)
    delay_frames: int = number(2, 1, 100, whole=True)
    """The command computed from frame k acts first during the exposure of frame k + delay_frames."""
    gain: float = number(0.5, 0.0, 2.0)
    leak: float = number(0.01, 0.0, 1.0)
    """Fraction by which commands decay in each frame, so that a loop recovers after it lost the star."""
    mode: str = setting(CLOSED, choices=(CLOSED, OPEN))
    """"closed", or "open": the sensor does not see the mirror."""
    largest_condition: float = number(30.0, 1.0, 1e6)
    """Largest condition number of the reconstructor; weaker modes are not controlled."""
    telemetry_frames: int = number(2000, 260, 1_000_000, whole=True)
    """Length of the closed loop with an integrator from which other controllers learn; never scored."""
    winds: str = setting(LEARNT, choices=WINDS)
    """Winds of a predictive model: "learnt" from telemetry, "assumed" (those of the atmosphere) or "none"."""


@dataclass(frozen=True)
class Science(ConfigurationTable, table="science"):
    """Wavelength and field of the Strehl ratio, on axis."""

    wavelength_m: float = number(1.65e-6, 1e-7, 1e-4)
    static_error_nm: float = number(0.0, 0.0, 1e4)
    """Rms of the wavefront error that the sensor does not see: Strehl ratios are lower by exp(-phase^2)."""

    @property
    def static_strehl(self) -> float:
        """Strehl ratio that the static error leaves (extended Marechal approximation)."""
        return math.exp(-((2e-9 * math.pi * self.static_error_nm / self.wavelength_m) ** 2))


@dataclass(frozen=True)
class RunLength(ConfigurationTable, table="run"):
    """Length and number of runs."""

    frames: int = number(1500, 1, 10_000_000, whole=True)
    settle_frames: int = number(100, 0, 10_000_000, whole=True)
    """Number of frames at the beginning that are not scored."""
    seed: int = number(1, 0, 2**63 - 1, whole=True)
    realisations: int = number(5, 1, 100_000, whole=True)
    photons_per_subaperture: tuple[float, ...] = number((), 0.0, 1e9, low_open=True, kind=LIST)
    """Fluxes at which estimators are compared."""


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
