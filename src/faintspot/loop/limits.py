"""Which values a loop's configuration may hold."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from faintspot.checks import number_between, numbers_between
from faintspot.errors import InputError

# Lowest and highest value, and whether the lowest is refused itself.
_LIMITS: dict[str, tuple[float, float, bool]] = {
    "telescope.diameter_m": (0.05, 100.0, False),
    "telescope.obstruction": (0.0, 0.9, False),
    "sensor.subapertures": (1, 200, False),
    "sensor.subaperture_m": (0.0, 100.0, True),
    "sensor.pixels": (4, 64, False),
    "sensor.wavelength_m": (1e-7, 1e-4, False),
    "sensor.pixel_scale_arcsec": (0.0, 100.0, True),
    "sensor.least_illumination": (0.0, 1.0, True),
    "sensor.samples": (4, 128, False),
    "sensor.spot_elongation": (1.0, 30.0, False),
    "mirror.actuators": (2, 201, False),
    "mirror.crosstalk": (0.0, 0.9, True),
    "atmosphere.r0_m": (0.01, 1e3, False),
    "atmosphere.drift_time_s": (0.0, 1e6, True),
    "atmosphere.outer_scale_m": (0.5, 200.0, False),
    "atmosphere.altitude_m": (0.0, 1e5, False),
    "atmosphere.fraction": (0.0, 1e6, False),
    "atmosphere.wind_speed_m_per_s": (0.0, 200.0, False),
    "atmosphere.wind_direction_deg": (-360.0, 360.0, False),
    "camera.photons_per_subaperture": (0.0, 1e9, True),
    "camera.magnitude": (-30.0, 60.0, False),
    "camera.zero_point": (0.0, 1e20, True),
    "camera.throughput": (0.0, 1.0, True),
    "camera.quantum_efficiency": (0.0, 1.0, True),
    "camera.read_noise_e": (0.0, 1e6, False),
    "camera.em_gain": (1.0, 1e5, False),
    "camera.gain_e_per_adu": (0.0, 1e6, True),
    "camera.offset_adu": (-1e6, 1e6, False),
    "camera.bits": (1, 32, False),
    "camera.background_e": (0.0, 1e6, False),
    "camera.dark_e": (0.0, 1e6, False),
    "control.frame_rate_hz": (0.0, 1e5, True),
    "control.gain": (0.0, 2.0, False),
    "control.leak": (0.0, 1.0, False),
    "control.largest_condition": (1.0, 1e6, False),
    "control.delay_frames": (1, 100, False),
    "science.wavelength_m": (1e-7, 1e-4, False),
    "run.frames": (1, 10_000_000, False),
    "run.settle_frames": (0, 10_000_000, False),
    "run.seed": (0, 2**63 - 1, False),
    "run.realisations": (1, 100_000, False),
    "run.photons_per_subaperture": (0.0, 1e9, True),
}
_WHOLE = {
    "sensor.subapertures",
    "sensor.pixels",
    "sensor.samples",
    "mirror.actuators",
    "camera.bits",
    "control.delay_frames",
    "run.frames",
    "run.settle_frames",
    "run.seed",
    "run.realisations",
}
_LISTS = {
    "atmosphere.altitude_m",
    "atmosphere.fraction",
    "atmosphere.wind_speed_m_per_s",
    "atmosphere.wind_direction_deg",
    "run.photons_per_subaperture",
}

_NUMBER_OR_LIST = "atmosphere.r0_m"


def checked_section(name: str, section: Any, kind: type[Any]) -> Any:
    """Return a section of a configuration with its numbers checked and its lists as tuples.

    Raises
    ------
    InputError
        When it is of another kind or a value is out of its range.
    """
    if not isinstance(section, kind):
        raise InputError(f"{name}: expected {kind.__name__}, got {type(section).__name__}")
    checked = {}
    for item in fields(section):
        where, value = f"{name}.{item.name}", getattr(section, item.name)
        if where in _LIMITS and value is not None:
            checked[item.name] = _checked_number(where, value)
    return replace(section, **checked)


def _checked_number(where: str, value: Any) -> Any:
    low, high, low_open = _LIMITS[where]
    whole = where in _WHOLE
    if where in _LISTS or (where == _NUMBER_OR_LIST and np.ndim(value) == 1):
        if np.ndim(value) != 1:
            raise InputError(f"{where}: expected a list of numbers, got {value!r}")
        if not len(value):
            return ()
        return tuple(numbers_between(where, value, low, high, low_open=low_open).tolist())
    number = number_between(where, value, low, high, integer=whole, low_open=low_open)
    return int(number) if whole else number
