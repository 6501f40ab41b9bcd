"""Reading sensors from files of the Adaptive Optics Telemetry standard (AOT, FITS), with aotpy.

Where the standard is not specific, faintspot's conventions apply: rows of an image are its vertical axis,
positions are counted from 0, slopes are in px from the centre of a sub-aperture's window.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import check_shape, finite_array
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import check_bytes, memory_bytes
from faintspot.io.fits_units import AOT_VERSION, SIDE, is_aot, units_of
from faintspot.io.stored_array import one_line

_PIXELS = ("pix", "pixel", "px")


@dataclass(frozen=True, eq=False, repr=False)
class AotSensor:
    """A Shack-Hartmann sensor of an AOT file, with the data that the file holds; missing data are None.

    Examples
    --------
    >>> from faintspot.io import read_aot
    >>> sensor = read_aot("night.fits")  # doctest: +SKIP
    >>> sensor.n, sensor.unit  # doctest: +SKIP
    """

    path: Path
    name: str
    """Unique identifier (UID)."""
    n: int
    """Number of sub-apertures."""
    layout: Mapping[str, Any] | None
    """Arguments of `faintspot.Layout`."""
    reference: NDArray[np.float64] | None
    """Slopes that are to be or were subtracted, (2 n,): px from the layout's centres, all x, then all y."""
    pixels: str | None
    """Name of the image with the frames: `open_frames` reads "file:pixels"."""
    image_frame: NDArray[np.float64]
    """Numbers of those frames; empty if the file has none."""
    slopes: NDArray[Any] | None
    """Slopes as stored, (t, 2, n): x and y, in `unit`."""
    unit: str
    frame: NDArray[np.float64]
    """Frame numbers of the slopes; empty if the file has none."""
    unix_time_s: NDArray[np.float64]
    """Times of the slopes; empty if the file has none."""
    flux: NDArray[Any] | None
    """Flux as stored, (t, n)."""
    interaction: NDArray[np.float64] | None
    """Interaction matrix of the first loop with one, (2 n, commands): all x, then all y, per unit command."""
    cells: NDArray[np.int64] | None
    """(n, 2): row and column of each sub-aperture."""
    diameter_m: float | None
    """Diameter of the telescope's pupil."""
    pixel_scale_arcsec: float | None
    subaperture_m: float | None = None
    """Side of a sub-aperture; in files of faintspot alone."""
    is_closed: bool = True
    """Whether the loop is closed that the sensor drives: the first one with commands, else the first one."""
    commands: NDArray[np.float64] | None = None
    """(t, commands)"""
    control_matrix: NDArray[np.float64] | None = None
    """(commands, 2 n): slopes all x, then all y."""
    frame_rate_hz: float | None = None
    delay_frames: float | None = None
    """From the middle of an exposure to the middle of its command."""

    def __repr__(self) -> str:
        """Return the name, the number of sub-apertures and the available data."""
        names = ("layout", "pixels", "slopes", "reference", "interaction")
        what = [name for name in names if getattr(self, name) is not None]
        return f"AotSensor({self.name!r}, {self.n} sub-apertures, {', '.join(what) or 'no data'})"


def read_aot(path: str | Path, sensor: str | None = None) -> AotSensor:
    """Read a Shack-Hartmann sensor from an AOT file.

    Parameters
    ----------
    path : path
    sensor : str, optional
        UID of the sensor, or name of the image with its frames. Default: the only sensor, or the only one
        with pixels.

    Raises
    ------
    InputError
        When the file is not valid AOT, has no such sensor, or its data are inconsistent.
    MissingExtraError
        When aotpy is not installed.

    Examples
    --------
    >>> from faintspot.io import read_aot
    >>> sensor = read_aot("night.fits")  # doctest: +SKIP
    >>> sensor.n, sensor.unit  # doctest: +SKIP
    """
    path = Path(path)
    try:
        import aotpy
        from aotpy.io.fits import AOTFITSReader
    except ImportError:
        raise MissingExtraError("aotpy", "realtime", "Reading an AOT file") from None
    if not path.exists():
        raise InputError(f"{path}: no such file or directory")
    if not is_aot(path):
        raise InputError(f"{path}: expected an AOT file, whose header has {AOT_VERSION}")
    total = sum(unit.value_bytes for unit in units_of(path))
    check_bytes(path, total, memory_bytes() // 2, "telemetry")
    for unit in units_of(path):
        unit.check_tiles(str(path), path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about data that faintspot does not read
        try:
            # By default aotpy would ask for external images in a dialogue, or fetch them.
            system = AOTFITSReader(path, externals="ignore").get_system()
        except Exception as error:  # aotpy raises many kinds of errors on damaged files
            raise InputError(f"{path}: the AOT file is not valid ({one_line(error)})") from None
    sensors = [item for item in system.wavefront_sensors if isinstance(item, aotpy.ShackHartmann)]
    chosen = _chosen(path, sensors, sensor)
    loops = [
        loop for loop in system.loops if isinstance(loop, aotpy.ControlLoop) and loop.input_sensor is chosen
    ]
    try:
        return _sensor(path, chosen, system, loops)
    except InputError as error:
        raise InputError(f"{path}: sensor {chosen.uid!r}: {error}") from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        raise InputError(f"{path}: sensor {chosen.uid!r}: not valid AOT ({one_line(error)})") from None


def _chosen(path: Path, sensors: list[Any], name: str | None) -> Any:
    """Return the selected sensor."""
    listed = ", ".join(str(item.uid) for item in sensors) or "none"
    if name is not None:
        sensors = [item for item in sensors if name in (item.uid, _pixels_of(item))]
    elif len(sensors) > 1:
        sensors = [item for item in sensors if _pixels_of(item) is not None]
    if len(sensors) != 1:
        wanted = f"a Shack-Hartmann sensor {name!r}" if name else "one Shack-Hartmann sensor with pixels"
        hint = "; name one" if len(sensors) > 1 else ""
        raise InputError(f"{path}: expected {wanted}, it has: {listed}{hint}")
    return sensors[0]


def _pixels_of(sensor: Any) -> str | None:
    """Return the name of the image with a sensor's frames."""
    image = None if sensor.detector is None else sensor.detector.pixel_intensities
    return None if image is None or image.data is None else str(image.name)


def _sensor(path: Path, sensor: Any, system: Any, loops: list[Any]) -> AotSensor:
    n = int(sensor.n_valid_subapertures)
    name, size = _pixels_of(sensor), None
    pixels = None if name is None else sensor.detector.pixel_intensities
    if pixels is not None:
        if pixels.data.ndim not in (2, 3):
            shape = pixels.data.shape
            raise InputError(f"pixel_intensities: expected (frames, height, width), got shape {shape}")
        size = int(pixels.data.shape[-2]), int(pixels.data.shape[-1])
    slopes, flux = _data_of(sensor, "measurements", "t", 2, n), _data_of(sensor, "subaperture_intensities")
    numbers, times = _time_of(sensor.measurements)
    scale = _number(sensor.detector, "pixel_scale")
    return AotSensor(
        path,
        str(sensor.uid),
        n,
        _layout(sensor, n, size),
        _reference(sensor, n),
        name,
        _time_of(pixels)[0],
        slopes,
        "" if slopes is None else str(sensor.measurements.unit or ""),
        numbers,
        times,
        flux,
        _interaction([loop for loop in loops if loop.interaction_matrix], n),
        _cells(sensor, n),
        _number(system.main_telescope, "enclosing_diameter"),
        None if scale is None else scale * 180 / np.pi * 3600,
        next((float(item.value) for item in system.metadata if item.key == SIDE), None),
        **_loop(loops, n),
    )


def _loop(loops: list[Any], n: int) -> dict[str, Any]:
    """Return the values of the first loop with commands, else of the first one."""
    if not loops:
        return {}
    loop = next((loop for loop in loops if _data_of(loop, "commands") is not None), loops[0])
    commands = _data_of(loop, "commands", "t", "commands")
    control = _data_of(loop, "control_matrix", "commands", 2, n)
    return {
        "is_closed": bool(loop.closed),
        "commands": None if commands is None else commands.astype(np.float64),
        "control_matrix": None if control is None else control.reshape(len(control), -1).astype(np.float64),
        "frame_rate_hz": _number(loop, "framerate"),
        "delay_frames": _number(loop, "delay"),
    }


def _number(owner: object, name: str) -> float | None:
    """Return a positive number, or None."""
    value = None if owner is None else getattr(owner, name)
    return float(value) if value is not None and np.isfinite(value) and value > 0 else None


def _layout(sensor: Any, n: int, size: tuple[int, int] | None) -> dict[str, Any] | None:
    """Return arguments of a layout, in AOT a grid of squares of pixels; None if data for it are missing."""
    cells = _cells(sensor, n)
    if cells is None or not sensor.mask_offsets or sensor.subaperture_size is None:
        return None
    if len(sensor.mask_offsets) != 1:
        raise InputError(f"mask_offsets: expected one, got {len(sensor.mask_offsets)}")
    side, offset = float(sensor.subaperture_size), sensor.mask_offsets[0]
    first = np.array([float(offset.y), float(offset.x)])
    corners = np.rint(finite_array("mask_offsets", first) + cells * side).astype(np.int64)
    window = int(side)
    if size is None:
        bottom, right = (corners + window).max(axis=0).tolist()
        size = bottom, right
    return {"frame_shape": size, "window": (window, window), "corners": corners, "cells": cells}


def _cells(sensor: object, n: int) -> NDArray[np.int64] | None:
    """Return row and column of the sub-apertures, (n, 2); None without a mask."""
    mask = _data_of(sensor, "subaperture_mask")
    if mask is None:
        return None
    numbers = mask[mask >= 0]
    if not np.array_equal(np.sort(numbers), np.arange(n)):
        raise InputError(f"subaperture_mask: expected the numbers 0 to {n - 1}, each once, got other numbers")
    return np.argwhere(mask >= 0)[np.argsort(numbers)]


def _reference(sensor: Any, n: int) -> NDArray[np.float64] | None:
    """Return the reference slopes if they are in pixels."""
    image = sensor.ref_measurements
    if image is None or str(image.unit).lower() not in _PIXELS:
        return None
    values = _data_of(sensor, "ref_measurements", 2, n)
    if values is None:
        return None
    return finite_array("ref_measurements", values).astype(np.float64).reshape(-1)


def _interaction(loops: Sequence[object], n: int) -> NDArray[np.float64] | None:
    """Return the interaction matrix, (2 n, commands)."""
    values = _data_of(loops[0], "interaction_matrix", n, 2, "commands") if loops else None
    if values is None:
        return None
    matrix: NDArray[np.float64] = values.swapaxes(0, 1).reshape(2 * n, -1).astype(np.float64)
    return matrix


def _data_of(owner: object, name: str, *shape: int | str) -> Any:
    """Return an image's data in native byte order, or None; of this shape, in which words are any number."""
    image = None if owner is None else getattr(owner, name)
    if image is None or image.data is None:
        return None
    data = np.asarray(image.data)
    if shape:
        check_shape(name, data, shape)
    return data.astype(data.dtype.newbyteorder("="), copy=False)


def _time_of(image: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frame numbers and times of an image; empty if it has none."""
    time = None if image is None else image.time
    values = ([], []) if time is None else (time.frame_numbers, time.timestamps)
    numbers, stamps = (np.asarray([] if data is None else data, np.float64) for data in values)
    return numbers, stamps
