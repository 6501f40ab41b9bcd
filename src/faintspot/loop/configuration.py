"""What a closed-loop experiment simulates: telescope, sensor, mirror, air, camera and control (TOML)."""

from __future__ import annotations

import dataclasses
import difflib
import math
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from faintspot.checks import one_of
from faintspot.errors import InputError
from faintspot.loop.limits import checked_section
from faintspot.planner.photometry import DEFAULT_BAND, ZERO_POINTS, Photometry

ARCSEC = math.pi / 180 / 3600
"""Radians in one arcsecond."""
R0_WAVELENGTH_M = 500e-9
"""Wavelength at which r0 is given."""

CLOSED, OPEN = "closed", "open"


@dataclass(frozen=True)
class Telescope:
    """The telescope's pupil."""

    diameter_m: float = 4.2
    obstruction: float = 0.29
    """Diameter of the central obstruction as a fraction of the pupil's."""


@dataclass(frozen=True)
class Sensor:
    """The Shack-Hartmann sensor."""

    subapertures: int = 7
    """Sub-apertures across the pupil."""
    subaperture_m: float | None = None
    """Side of a sub-aperture in the pupil. Default: the sub-apertures just cover the pupil."""
    pixels: int = 16
    """Pixels across a sub-aperture's window."""
    wavelength_m: float = 650e-9
    pixel_scale_arcsec: float | None = None
    """Default: two pixels for lambda / d."""
    least_illumination: float = 0.5
    """Part of its area in the pupil from which a sub-aperture is used."""
    samples: int = 12
    """Points of the phase across a sub-aperture."""
    spot_elongation: float = 1.0
    """Full width at half maximum of a spot along x as a multiple of that along y, before the pixels."""


@dataclass(frozen=True)
class Mirror:
    """The deformable mirror."""

    actuators: int | None = None
    """Actuators across the pupil, its edges included. Default: one at each corner of the sub-apertures."""
    crosstalk: float = 0.15
    """Height of an actuator's Gaussian influence function at its neighbour."""
    tip_tilt: bool = True
    """Whether a tip-tilt mirror helps."""


@dataclass(frozen=True)
class Atmosphere:
    """Layers of frozen turbulence that the wind moves; the star is on axis and altitudes do not matter."""

    r0_m: float | tuple[float, float] = 0.15
    """Fried parameter at 500 nm; or the two ends between which it drifts."""
    drift_time_s: float = 60.0
    """Period of the drift."""
    outer_scale_m: float = 25.0
    altitude_m: tuple[float, ...] = (0.0, 2500.0, 4000.0, 13500.0)
    fraction: tuple[float, ...] = (0.45, 0.25, 0.15, 0.15)
    """Strength of each layer; their ratios matter."""
    wind_speed_m_per_s: tuple[float, ...] = (6.0, 9.0, 14.0, 22.0)
    wind_direction_deg: tuple[float, ...] = (20.0, 80.0, 150.0, 250.0)


@dataclass(frozen=True)
class Camera:
    """The sensor's camera and the star's light on it; as `faintspot.simulate.Detector`."""

    photons_per_subaperture: float | None = None
    """Photo-electrons of a fully lit sub-aperture in a frame; or give the magnitude."""
    magnitude: float | None = None
    band: str = DEFAULT_BAND
    zero_point: float | None = None
    """Photons per second and m^2 of magnitude 0. Default: that of the band."""
    throughput: float = 0.4
    quantum_efficiency: float = 0.9
    read_noise_e: float = 0.1
    """At the camera's output, after multiplication."""
    em_gain: float = 1.0
    gain_e_per_adu: float = 1.0
    offset_adu: float = 0.0
    bits: int | None = None
    background_e: float = 0.0
    dark_e: float = 0.0


@dataclass(frozen=True)
class Control:
    """The loop."""

    frame_rate_hz: float = 250.0
    delay_frames: int = 2
    """The command computed from frame k acts first during the exposure of frame k + delay_frames."""
    gain: float = 0.5
    leak: float = 0.01
    """Part of the command that is forgotten in every frame, so that a loop that has lost the star returns."""
    mode: str = CLOSED
    """"closed", or "open": the sensor does not see the mirror."""
    largest_condition: float = 30.0
    """Combinations of actuators that move the slopes so many times less than the best one are not driven."""


@dataclass(frozen=True)
class Science:
    """Where the Strehl ratio is measured, on axis."""

    wavelength_m: float = 1.65e-6


@dataclass(frozen=True)
class Run:
    """How long and how often."""

    frames: int = 1500
    settle_frames: int = 100
    """Frames at the beginning that are not scored."""
    seed: int = 1
    realisations: int = 5
    photons_per_subaperture: tuple[float, ...] = ()
    """Fluxes at which estimators are compared."""


@dataclass(frozen=True)
class LoopConfiguration:
    """Everything that a closed-loop experiment is made of.

    Raises
    ------
    InputError
        For a value out of its range, and for parts that do not fit together: an aperture smaller than a
        sub-aperture or than all of them cover, a window that the phase's points cannot fill, layers with
        lists of different lengths, no light or two amounts of it.
    """

    name: str = "canary"
    telescope: Telescope = field(default_factory=Telescope)
    sensor: Sensor = field(default_factory=Sensor)
    mirror: Mirror = field(default_factory=Mirror)
    atmosphere: Atmosphere = field(default_factory=Atmosphere)
    camera: Camera = field(default_factory=lambda: Camera(photons_per_subaperture=100.0))
    control: Control = field(default_factory=Control)
    science: Science = field(default_factory=Science)
    run: Run = field(default_factory=Run)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"name: expected a text, got {self.name!r}")
        for name in SECTIONS:
            object.__setattr__(self, name, checked_section(name, getattr(self, name), SECTIONS[name]))
        _check_layers(self.atmosphere)
        _check_light(self.camera)
        _check_sampling(self)

    def replace(self, section: str, **values: Any) -> LoopConfiguration:
        """Return the configuration with some values of one section changed.

        Raises
        ------
        InputError
            For an unknown section or key, or a bad value.
        """
        _check_known("", section, list(SECTIONS), "section")
        known = [item.name for item in fields(SECTIONS[section])]
        for key in values:
            _check_known(f"{section}.", key, known, "key")
        changed = dataclasses.replace(getattr(self, section), **values)
        return dataclasses.replace(self, **{section: changed})

    @property
    def subaperture_m(self) -> float:
        """Side of a sub-aperture."""
        given = self.sensor.subaperture_m
        return self.telescope.diameter_m / self.sensor.subapertures if given is None else given

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
    def photons(self) -> float:
        """Photo-electrons of a fully lit sub-aperture in a frame."""
        camera = self.camera
        if camera.photons_per_subaperture is not None:
            return camera.photons_per_subaperture
        return float(self.photometry.electrons(camera.magnitude or 0.0))

    @property
    def photometry(self) -> Photometry:
        """From magnitudes to photo-electrons and back."""
        return Photometry(
            self.subaperture_m**2,
            1 / self.control.frame_rate_hz,
            self.camera.band,
            self.camera.zero_point,
            self.camera.throughput,
            self.camera.quantum_efficiency,
        )

    def to_text(self) -> str:
        """Return the configuration as TOML with every value written out."""
        document = tomlkit.document()
        document["name"] = self.name
        for name in SECTIONS:
            table = tomlkit.table()
            for item in fields(SECTIONS[name]):
                value = getattr(getattr(self, name), item.name)
                if value is not None:  # TOML has no word for nothing
                    table[item.name] = list(value) if isinstance(value, tuple) else value
            document[name] = table
        return tomlkit.dumps(document)

    @classmethod
    def from_text(cls, text: str, where: str = "configuration") -> LoopConfiguration:
        """Read a configuration from TOML text; `where` names it in messages.

        Raises
        ------
        InputError
            When it is not TOML, has an unknown table or key, or a bad value.
        """
        try:
            document: dict[str, Any] = tomlkit.parse(text).unwrap()
        except TOMLKitError as error:
            raise InputError(f"{where}: not a TOML file: {str(error).splitlines()[0]}") from None
        try:
            return _build(document)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None


SECTIONS: dict[str, type[Any]] = {
    "telescope": Telescope,
    "sensor": Sensor,
    "mirror": Mirror,
    "atmosphere": Atmosphere,
    "camera": Camera,
    "control": Control,
    "science": Science,
    "run": Run,
}


def load_loop(path: str | Path) -> LoopConfiguration:
    """Read the configuration of a loop: a TOML file, or one of `shipped_loops` by its name.

    Raises
    ------
    InputError
        When there is neither, or as for `LoopConfiguration.from_text`.
    """
    path = Path(path)
    name = path.name.removesuffix(".toml")
    # A folder of that name holds results of an earlier run.
    if not path.is_file() and path.parent == Path() and name in shipped_loops():
        text = (_shipped() / f"{name}.toml").read_text(encoding="utf-8")
        return LoopConfiguration.from_text(text, f"{name}.toml")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        shipped = ", ".join(shipped_loops())
        raise InputError(f"{path}: no such file, and none of the shipped configurations: {shipped}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a TOML file: it is not UTF-8 text") from None
    return LoopConfiguration.from_text(text, str(path))


def shipped_loops() -> list[str]:
    """Return the names of the configurations that come with the package."""
    names = (item.name for item in _shipped().iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def _shipped() -> Any:
    return resources.files("faintspot.loop") / "configurations"


def _build(document: dict[str, Any]) -> LoopConfiguration:
    for key in document:
        _check_known("", key, ["name", *SECTIONS], "table")
    values: dict[str, Any] = {}
    for name, table in document.items():
        if name == "name":
            values[name] = table
            continue
        if not isinstance(table, dict):
            raise InputError(f"{name}: expected a table [{name}], got {table!r}")
        known = [item.name for item in fields(SECTIONS[name])]
        for key in table:
            _check_known(f"{name}.", key, known, "key")
        values[name] = SECTIONS[name](**table)
    return LoopConfiguration(**values)


def _check_known(prefix: str, name: str, known: list[str], what: str) -> None:
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
        raise InputError(f"{prefix}{name}: unknown {what}; {hint}")


def _check_layers(air: Atmosphere) -> None:
    names = ("altitude_m", "fraction", "wind_speed_m_per_s", "wind_direction_deg")
    lengths = {name: len(getattr(air, name)) for name in names}
    if len(set(lengths.values())) > 1 or not air.fraction:
        found = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"atmosphere: expected lists with one value for each layer, got {found}")
    if sum(air.fraction) <= 0:
        raise InputError("atmosphere.fraction: expected at least one layer with a strength above 0")
    if isinstance(air.r0_m, tuple) and (len(air.r0_m) != 2 or air.r0_m[0] > air.r0_m[1]):
        raise InputError(f"atmosphere.r0_m = {list(air.r0_m)}: expected one number or [lowest, highest]")


def _check_light(camera: Camera) -> None:
    if (camera.photons_per_subaperture is None) == (camera.magnitude is None):
        raise InputError("camera: expected either photons_per_subaperture or magnitude")
    one_of("camera.band", camera.band, list(ZERO_POINTS))


def _check_sampling(whole: LoopConfiguration) -> None:
    """Refuse what the sensor's phase cannot hold and control that cannot be."""
    one_of("control.mode", whole.control.mode, (CLOSED, OPEN))
    if not isinstance(whole.mirror.tip_tilt, bool):
        raise InputError(f"mirror.tip_tilt = {whole.mirror.tip_tilt!r}: expected true or false")
    sensor = whole.sensor
    diameter, side = whole.telescope.diameter_m, whole.subaperture_m
    if side > diameter:
        raise InputError(
            f"telescope.diameter_m = {diameter:g}: expected at least one sub-aperture, "
            f"sensor.subaperture_m = {side:g}"
        )
    if whole.width_m < diameter * (1 - 1e-9):
        raise InputError(
            f"sensor.subapertures = {sensor.subapertures} of {side:g} m: expected enough to cover the "
            f"{diameter:g} m of the telescope"
        )
    needed = math.ceil(field_of_view(whole) / whole.spot_width_px)
    if sensor.samples < needed:
        raise InputError(
            f"sensor.samples = {sensor.samples}: expected at least {needed} for a field of "
            f"{field_of_view(whole):.3g} px with lambda / d = {whole.spot_width_px:.3g} px"
        )
    if whole.run.settle_frames >= whole.run.frames:
        raise InputError(
            f"run.settle_frames = {whole.run.settle_frames}: expected fewer than the {whole.run.frames} "
            "frames"
        )


def field_of_view(whole: LoopConfiguration) -> float:
    """Return the width of the images behind the lenslets that must not repeat itself, px."""
    return whole.sensor.pixels * 1.125 + 2 * 3 * blur_px(whole)


def blur_px(whole: LoopConfiguration) -> float:
    """Return the standard deviation along x of the source that elongates the spots, px."""
    width = 0.886 * whole.spot_width_px  # full width at half maximum of sinc^2
    return width * math.sqrt(whole.sensor.spot_elongation**2 - 1) / 2.3548
