"""Configuration of a simulated closed loop: telescope, sensor, mirror, atmosphere, camera, control (TOML)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import check_size
from faintspot.base.statistics import FWHM_TO_STD
from faintspot.base.tables import ConfigurationTable, tables_as_text
from faintspot.base.text_files import check_keys, check_known, checked_table, parse_file, parse_text
from faintspot.loop.simulation import sections
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.simulate.photometry import Photometry
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M

SPOT_FWHM = 0.886  # full width at half maximum of sinc^2, in lambda / d
_MOST_POINTS = 4096**2  # of a wavefront
_POSITION_RANGE_PX = {sections.CLOSED: 2.0, sections.OPEN: 5.0}


@dataclass(frozen=True)
class LoopConfiguration:
    """Configuration of a closed-loop experiment.

    Raises
    ------
    InputError
        For a value out of its range, and for parts that do not fit together: an aperture smaller than a
        sub-aperture or than all of them cover, a window that the phase's points cannot fill, layers with
        lists of different lengths, no flux or two amounts of it.

    Examples
    --------
    >>> from faintspot.loop.simulation import LoopConfiguration
    >>> loop = LoopConfiguration().replace("camera", photons_per_subaperture=50.0)
    >>> loop.name, loop.sensor.subapertures, round(loop.subaperture_m, 2)
    ('canary', 7, 0.6)
    """

    name: str = "canary"
    telescope: sections.Telescope = field(default_factory=sections.Telescope)
    sensor: sections.SensorParameters = field(default_factory=sections.SensorParameters)
    mirror: sections.Mirror = field(default_factory=sections.Mirror)
    atmosphere: sections.Atmosphere = field(default_factory=sections.Atmosphere)
    camera: sections.Camera = field(default_factory=lambda: sections.Camera(photons_per_subaperture=100.0))
    control: sections.ControlParameters = field(default_factory=sections.ControlParameters)
    science: sections.Science = field(default_factory=sections.Science)
    run: sections.RunLength = field(default_factory=sections.RunLength)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"name: expected a text, got {self.name!r}")
        for name in SECTIONS:
            section = getattr(self, name)
            if not isinstance(section, SECTIONS[name]):
                got = type(section).__name__
                raise InputError(f"expected {SECTIONS[name].__name__}, got {got}", name=name)
        _check_layers(self.atmosphere)
        _check_flux(self.camera)
        _check_sampling(self)

    def replace(self, section: str, **values: object) -> LoopConfiguration:
        """Return the configuration with some values of one section changed.

        Raises
        ------
        InputError
            For an unknown section or key, or a bad value.
        """
        check_known("", section, SECTIONS, "section")
        check_keys(f"{section}.", values, [item.name for item in fields(SECTIONS[section])])
        changed: Any = dataclasses.replace(getattr(self, section), **values)
        return dataclasses.replace(self, **{section: changed})

    def slowed_to(self, rate_hz: float) -> LoopConfiguration:
        """Return the same loop at another frame rate, with winds that move the turbulence as far in a frame.

        Raises
        ------
        InputError
            For a rate or winds out of range.
        """
        part = rate_hz / self.control.frame_rate_hz
        winds = tuple(part * speed for speed in self.atmosphere.wind_speed_m_per_s)
        slower = self.replace("control", frame_rate_hz=rate_hz)
        return slower.replace("atmosphere", wind_speed_m_per_s=winds)

    @property
    def subaperture_m(self) -> float:
        """Side of a sub-aperture."""
        side_m = self.sensor.subaperture_m
        return self.telescope.diameter_m / self.sensor.subapertures if side_m is None else side_m

    @property
    def width_m(self) -> float:
        """Width of all sub-apertures together, which the pupil lies in."""
        return self.subaperture_m * self.sensor.subapertures

    @property
    def pixel_scale_rad(self) -> float:
        """Angle on the sky that a pixel sees."""
        if self.sensor.pixel_scale_arcsec is None:
            return self.sensor.wavelength_m / self.subaperture_m / 2
        return self.sensor.pixel_scale_arcsec * ARCSEC

    @property
    def spot_width_px(self) -> float:
        """Width of a spot, lambda / d, in pixels."""
        return self.sensor.wavelength_m / self.subaperture_m / self.pixel_scale_rad

    @property
    def d_over_r0(self) -> float:
        """Side of a sub-aperture in Fried parameters at the sensor's wavelength, in the worst seeing."""
        r0_sensing = np.min(self.atmosphere.r0_m) * (self.sensor.wavelength_m / R0_WAVELENGTH_M) ** (6 / 5)
        return self.subaperture_m / float(r0_sensing)

    def position_range_px(self, *, predicted: bool = False) -> float:
        """Return the largest distance of spots from the reference, or from the predicted position."""
        return _POSITION_RANGE_PX[sections.CLOSED if predicted else self.control.mode]

    @property
    def scene(self) -> Scene:
        """Knowledge that estimators have when their options are chosen."""
        camera = self.camera
        elongation = self.sensor.spot_elongation
        return Scene(
            flux_e=self.photons,
            read_noise_e=camera.read_noise_e / camera.em_gain,
            window=(self.sensor.pixels,) * 2,
            spot_fwhm_px=SPOT_FWHM * self.spot_width_px * math.sqrt(elongation),
            position_range_px=self.position_range_px(),
            elongation=elongation,
            excess_noise=2.0 if camera.em_gain > 1 else 1.0,
            background_e=camera.background_e + camera.dark_e,
            d_over_r0=self.d_over_r0,
            diffraction_px=self.spot_width_px,
        )

    @property
    def photons(self) -> float:
        """Photo-electrons of a fully illuminated sub-aperture in a frame."""
        camera = self.camera
        if camera.photons_per_subaperture is not None:
            return camera.photons_per_subaperture
        return float(self.photometry.electrons(camera.magnitude or 0.0))

    @property
    def photometry(self) -> Photometry:
        """Conversion between magnitudes and photo-electrons."""
        return self.camera.photometry_of(self.subaperture_m, self.control.frame_rate_hz)

    def to_text(self) -> str:
        """Return the configuration as TOML with every value written out."""
        sections = {name: vars(section) for name in SECTIONS if (section := getattr(self, name)) is not None}
        known = {
            name: {key: value for key, value in values.items() if value is not None}
            for name, values in sections.items()
        }
        return tables_as_text({"name": self.name, **known})

    @classmethod
    def from_text(cls, text: str, where: str = "configuration") -> LoopConfiguration:
        """Read a configuration from TOML text; `where` names it in messages.

        Raises
        ------
        InputError
            When it is not TOML, has an unknown table or key, or a bad value.
        """
        return cls.from_document(parse_text(text, where), where)

    @classmethod
    def of_results(cls, text: str) -> LoopConfiguration | None:
        """Return the configuration that results state; None if they state none, or one of another version."""
        try:
            return cls.from_text(text) if text else None
        except InputError:
            return None

    @classmethod
    def from_document(cls, document: dict[str, Any], where: str) -> LoopConfiguration:
        """Make a configuration of the tables of a TOML file.

        Raises
        ------
        InputError
            For an unknown table or key, or a bad value.
        """
        with errors_within(where):
            check_keys("", document, ["name", *SECTIONS], what="table")
            sections = {
                name: SECTIONS[name].from_table(checked_table(name, table))
                for name, table in document.items()
                if name != "name"
            }
            return cls(**{**document, **sections})


SECTIONS: dict[str, type[ConfigurationTable]] = {
    "telescope": sections.Telescope,
    "sensor": sections.SensorParameters,
    "mirror": sections.Mirror,
    "atmosphere": sections.Atmosphere,
    "camera": sections.Camera,
    "control": sections.ControlParameters,
    "science": sections.Science,
    "run": sections.RunLength,
}


def load_loop(path: str | Path) -> LoopConfiguration:
    """Read the configuration of a loop: a TOML file, or one of `shipped_loops` by its name.

    Raises
    ------
    InputError
        When there is neither, or as for `LoopConfiguration.from_text`.

    Examples
    --------
    >>> from faintspot.loop.simulation import load_loop
    >>> canary = load_loop("canary")
    >>> canary.telescope.diameter_m, canary.control.frame_rate_hz
    (4.2, 150.0)
    """
    path = Path(path)
    name = path.name.removesuffix(".toml")
    # A folder of that name holds results of an earlier run.
    if not path.is_file() and path.parent == Path() and name in shipped_loops():
        document, where = parse_file(_shipped() / f"{name}.toml"), f"{name}.toml"
    else:
        shipped = ", ".join(shipped_loops())
        document = parse_file(path, if_missing=f"none of the shipped configurations either: {shipped}")
        where = str(path)
    return LoopConfiguration.from_document(document, where)


def shipped_loops() -> list[str]:
    """Return the names of the configurations that come with the package.

    Examples
    --------
    >>> from faintspot.loop.simulation import shipped_loops
    >>> shipped_loops()[:4]
    ['camera_3e', 'canary', 'diffraction_limit', 'eight_metre']
    """
    names = (item.name for item in _shipped().iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def _shipped() -> Any:
    return resources.files("faintspot.loop.simulation") / "presets"


def _check_layers(atmosphere: sections.Atmosphere) -> None:
    names = ("altitude_m", "fraction", "wind_speed_m_per_s", "wind_direction_deg")
    lengths = {name: len(getattr(atmosphere, name)) for name in names}
    if len(set(lengths.values())) > 1 or not atmosphere.fraction:
        lengths_text = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"atmosphere: expected lists with one value for each layer, got {lengths_text}")
    if sum(atmosphere.fraction) <= 0:
        raise InputError("atmosphere.fraction: expected at least one layer with a strength above 0")
    if isinstance(atmosphere.r0_m, tuple) and (
        len(atmosphere.r0_m) != 2 or atmosphere.r0_m[0] > atmosphere.r0_m[1]
    ):
        raise InputError(
            f"atmosphere.r0_m = {list(atmosphere.r0_m)}: expected one number or [lowest, highest]"
        )


def _check_flux(camera: sections.Camera) -> None:
    if (camera.photons_per_subaperture is None) == (camera.magnitude is None):
        raise InputError("camera: expected either photons_per_subaperture or magnitude")


def _check_sampling(loop: LoopConfiguration) -> None:
    """Refuse a sensor that is sampled too coarsely, and inconsistent control."""
    sensor = loop.sensor
    check_size(
        "sensor: (subapertures x samples)^2", [(sensor.subapertures * sensor.samples) ** 2], _MOST_POINTS
    )
    check_size(
        "sensor: (subapertures x pixels)^2", [(sensor.subapertures * sensor.pixels) ** 2], what="pixels"
    )
    actuators = loop.mirror.actuators or sensor.subapertures + 1
    check_size("interaction matrix (slopes, actuators)", (2 * sensor.subapertures**2, actuators**2))
    diameter, side = loop.telescope.diameter_m, loop.subaperture_m
    if side > diameter:
        raise InputError(
            f"telescope.diameter_m = {diameter:g}: expected at least one sub-aperture, "
            f"sensor.subaperture_m = {side:g}"
        )
    if loop.width_m < diameter * (1 - 1e-9):
        raise InputError(
            f"sensor.subapertures = {sensor.subapertures} of {side:g} m: expected enough to cover the "
            f"{diameter:g} m of the telescope"
        )
    samples = math.ceil(field_of_view(loop) / loop.spot_width_px)
    if sensor.samples < samples:
        raise InputError(
            f"sensor.samples = {sensor.samples}: expected at least {samples} for a field of "
            f"{field_of_view(loop):.3g} px with lambda / d = {loop.spot_width_px:.3g} px"
        )
    if loop.run.settle_frames >= loop.run.frames:
        raise InputError(
            f"run.settle_frames = {loop.run.settle_frames}: expected fewer than the {loop.run.frames} frames"
        )


def field_of_view(loop: LoopConfiguration) -> float:
    """Return the width of the lenslet images that must not alias [px]."""
    return loop.sensor.pixels * 1.125 + 2 * 3 * blur_px(loop)


def blur_px(loop: LoopConfiguration) -> float:
    """Return the standard deviation along x of the source that elongates the spots, px."""
    width = SPOT_FWHM * loop.spot_width_px
    return width * math.sqrt(loop.sensor.spot_elongation**2 - 1) * FWHM_TO_STD
