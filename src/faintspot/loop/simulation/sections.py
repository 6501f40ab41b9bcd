"""Sections of the configuration of a loop: telescope, sensor, atmosphere, camera, control, run."""

import math
from dataclasses import dataclass

from faintspot.base.options import FLAG, LIST, NUMBER_OR_LIST, number, setting
from faintspot.base.tables import ConfigurationTable
from faintspot.loop.control.base import LEARNT, WINDS
from faintspot.loop.control.options import IntegratorOptions
from faintspot.slopes.simulate.photometry import StarLight

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
class ControlParameters(IntegratorOptions, ConfigurationTable):
    """Control loop."""

    frame_rate_hz: float = number(250.0, 0.0, 1e5, low_open=True)
    gain: float = number(0.5, 0.0, 2.0)
    mode: str = setting(CLOSED, choices=(CLOSED, OPEN))
    """"closed", or "open": the sensor does not see the mirror."""
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
    seed: int = number(1, 0, 2**53, whole=True)
    realisations: int = number(5, 1, 100_000, whole=True)
    photons_per_subaperture: tuple[float, ...] = number((), 0.0, 1e9, low_open=True, kind=LIST)
    """Fluxes at which estimators are compared."""
