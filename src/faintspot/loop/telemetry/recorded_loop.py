"""Recorded loop of any system, read from its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import finite_array, increasing, one_of, real_array
from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import read_arrays
from faintspot.base.flags import NO_FLAG, SubapertureFlag, leave_out
from faintspot.base.text_files import check_keys, parse_file
from faintspot.io import StoredSlopes
from faintspot.io.fits_units import is_aot
from faintspot.io.frames import read_array
from faintspot.io.loop_streams import holds_session, holds_streams, read_session, read_streams
from faintspot.io.slopes import holds_slopes
from faintspot.io.zarr_store import holds_telemetry
from faintspot.loop.control.identification.recording import (
    NUMBERS,
    OFFSETS,
    Recording,
    cells_of,
    rows_of_slopes,
)
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.recorded.stored_run import open_run
from faintspot.slopes.sensor.pupil import side_m

if TYPE_CHECKING:
    from faintspot.loop.control.configuration import RecordedControl

UNITS = {"px": None, "arcsec": 1.0, "rad": 1 / ARCSEC}
"""Units of slopes, in arcsec."""
_OF_AOT = {"pix": "px", "pixel": "px", "px": "px", "arcsec": "arcsec", "rad": "rad"}
_ARRAYS = (
    *("slopes", "commands", "interaction_matrix", "control_matrix", "cells"),
    *("time_s", "frame", "flags", "flux"),
    *OFFSETS,
)
_OF_SENSOR = (
    *("frame", "cells", "diameter_m", "pixel_scale_arcsec", "subaperture_m"),
    *("commands", "control_matrix", "frame_rate_hz", "delay_frames", "flux"),
)
_SCALES = ("pixel_scale_arcsec", "subaperture_m", "diameter_m")
"""Scales of the telescope that a layout holds."""
_WORDS = ("slope_unit", "slope_order", "loop")
_NO_CELLS = "none"
_ASKED = {
    "commands": "--commands",
    "interaction_matrix": "--interaction-matrix or --control-matrix",
    "pixel_scale_arcsec": "--pixel-scale-arcsec",
    "subaperture_m": "--subaperture-m or --diameter-m",
}
"""Options for values without which a part of the report is missing."""
_ORDERS = _PAIRS, _AXES = "pairs", "axes"
_LEAST_RESPONSE = 0.3  # of the median, of slopes that are used
_GAIN_ERROR, _NONLINEAR = 0.02, 0.1  # relative errors of the gain: of all, and of small responses
_OF_LOST = 5.0  # relative error of the gain over the share of slopes at their limit


def read_recorded_loop(
    path: str | Path,
    system: str | Path | None = None,
    configuration: str | Path | None = None,
    stated: Mapping[str, float | str] | None = None,
) -> Recording:
    """Read a recording of a loop.

    Parameters
    ----------
    path : path
        A store of `faintspot realtime record`, slopes of `faintspot slopes` without a loop, an AOT file, a
        telemetry session of pyRTC, streams of milk's logger, a file or folder in one of the layouts of
        `io.loop_layouts`, a TOML file that names arrays, or a file with slopes.
    system : path, optional
        TOML with values that the recording lacks, or that replace its own.
    configuration : path, optional
        faintspot.toml with [control], for a store of `faintspot realtime record`. Default: as recorded.
    stated : dict, optional
        Values that replace those of files, such as frame_rate_hz; of arrays the name in the file, or a file.

    Raises
    ------
    InputError
        When a file cannot be read, shapes do not fit together, or rate, unit or geometry are missing; the
        message names the option.
    """
    path, stated = Path(path), dict(stated or {})
    if not path.exists():
        raise InputError(f"{path}: no such file or directory")
    words = {name: stated[name] for name in _ARRAYS if isinstance(stated.get(name), str)}
    named = {name: f"{stated.pop(name)}" for name, text in words.items() if text != _NO_CELLS}
    values = _values_of(path, configuration, named)
    given = {**({} if system is None else _system_values(Path(system))), **stated}
    with errors_within(path):
        return _loop(path.name, values | given, list(given))


def _values_of(path: Path, configuration: str | Path | None, named: dict[str, str]) -> dict[str, Any]:
    """Return the values of a recording of any kind, with arrays that options name."""
    if holds_streams(path):
        return read_streams(path, named)
    if path.suffix == ".toml":
        values = _system_values(path) | {"origin": "TOML file"}
    elif holds_session(path):
        values = read_session(path) | {"origin": "session of pyRTC"}
    elif path.is_dir() and holds_telemetry(path):
        values = _of_store(path, configuration) | {"origin": "recording of faintspot"}
    elif holds_slopes(path):
        values = _of_slopes(path) | {"origin": "slopes of faintspot"}
    elif path.suffix == ".npz" and "slopes" not in named:
        values = _of_table(path) | {"origin": "NumPy file"}
    elif path.is_file() and is_aot(path):
        values = _of_aot(path) | {"origin": "AOT file"}
    else:
        from faintspot.io.loop_layouts import read_layout  # only for such files

        return read_layout(path, named)
    return values | {name: read_array(text) for name, text in named.items()} | {"sources": named}


def _system_values(path: Path) -> dict[str, Any]:
    """Return the values of a TOML file, with the arrays that it names.

    Raises
    ------
    InputError
        When it cannot be read, or names something unknown.
    """
    values = parse_file(path)
    check_keys(f"{path}: ", values, [*_ARRAYS, *NUMBERS, *_WORDS])
    for name in _ARRAYS:
        if name in values and isinstance(values[name], str) and values[name] != _NO_CELLS:
            values[name] = read_array(path.parent / values[name])
    return values


def system_numbers(path: Path) -> dict[str, float]:
    """Return the numbers of a TOML file with values of a system, checked.

    Raises
    ------
    InputError
        When it cannot be read, names something unknown, or a number is out of range.
    """
    return _numbers(_system_values(path))


def _numbers(values: Mapping[str, object]) -> dict[str, float]:
    return {key: option.checked(key, values[key]) for key, option in NUMBERS.items() if key in values}


def _of_table(path: Path) -> dict[str, Any]:
    stored = read_arrays(path, "slopes of a loop")
    check_keys(f"{path}: ", stored, [*_ARRAYS, *NUMBERS, *_WORDS])
    return {name: array.item() if array.ndim == 0 else array for name, array in stored.items()}


def _of_store(path: Path, configuration: str | Path | None) -> dict[str, Any]:
    """Return the values of a recording of our own engine."""
    from faintspot.io.telemetry import CLOSED_LOOP, read_telemetry

    recording = read_telemetry(path, images=False)
    layout = recording.attributes["layout"]
    closed = np.asarray(recording.loop) == CLOSED_LOOP
    rows = closed if closed.any() else np.ones(len(recording.frame), np.bool_)
    values: dict[str, Any] = {
        "slopes": recording.slopes[rows].astype(np.float64),
        "flags": recording.flags[rows],
        "flux": recording.flux[rows],
        "slope_unit": "px",
        "frame": recording.frame[rows],
        "time_s": recording.last_row_time_ns[rows] / 1e9,
        "cells": np.asarray(layout["cells"]),
        "loop": "closed" if closed.any() else "open",
    }
    values |= {name: layout[name] for name in _SCALES if layout.get(name) is not None}
    control = control_of(recording.attributes, configuration)
    if recording.commands.shape[1]:
        values["commands"] = recording.commands[rows]
    if control is not None:
        values["interaction_matrix"] = control.interaction
        law = ", ".join(f"{name} = {value}" for name, value in control.options.chosen().items())
        values["control_law"] = law or "as by default"
        values["delay_frames"] = control.options.delay_frames
        if control.options.largest_command is not None:
            values["largest_command"] = control.options.largest_command
    return values


def control_of(
    attributes: Mapping[str, object], configuration: str | Path | None = None
) -> RecordedControl | None:
    """Return the control of an engine's recording, from a configuration file or as recorded.

    Raises
    ------
    InputError
        When either cannot be understood.
    """
    from faintspot.loop.control.configuration import RecordedControl, load_control, unpacked_control

    if configuration is None:
        return unpacked_control(attributes)
    control = load_control(configuration)
    return None if control is None else RecordedControl(control.interaction, control.options)


def _of_slopes(path: Path) -> dict[str, Any]:
    """Return the values of slopes that `faintspot slopes` wrote, taken as those of an open loop."""
    run = open_run(path, layout_only=True)
    layout = run.layout
    if layout is None:
        raise InputError(f"{path}: expected slopes with their layout ({' '.join(run.notes)})")
    if layout.geometry != "square":
        raise InputError(f"{path}: expected a square array of lenslets, got a {layout.geometry} one")
    slopes, usable, gain_error = _proportional(run.stored)
    x, y = np.split(slopes, 2, axis=1)
    angle = math.radians(layout.angle_deg)
    along, across = math.cos(angle) * x + math.sin(angle) * y, math.cos(angle) * y - math.sin(angle) * x
    values: dict[str, Any] = {
        "slopes": np.hstack([along, across]),
        "flags": run.stored.variables["flags"] & ~np.uint8(run.keep | usable),
        "flux": run.stored.variables["flux"],
        "slope_unit": "px",
        "cells": layout.cells,
        "loop": "open",
        "gain_error": gain_error,
    }
    return values | {name: scale for name in _SCALES if (scale := getattr(layout, name)) is not None}


def _proportional(stored: StoredSlopes) -> tuple[Floats, SubapertureFlag, float]:
    """Return slopes (frames, 2 n) divided by their response, NaN where that is low, and its relative error.

    The flags of slopes that count nevertheless: those at the edges of their windows are the largest ones, and
    the response is that with them. Where it is not known it is taken to be 1, and they are lost.
    """
    slopes = np.hstack([stored.variables[axis] for axis in "xy"]).astype(np.float64)
    limited = SubapertureFlag.AT_SEARCH_LIMIT
    share = float((stored.variables["flags"] & limited != 0).mean())
    if "response" not in stored.attributes:
        return slopes, NO_FLAG, math.hypot(_GAIN_ERROR, _OF_LOST * share)
    response = np.asarray(stored.attributes["response"], np.float64)
    low = response < _LEAST_RESPONSE * max(float(np.median(response)), 0.0)
    slopes = np.where(low, np.nan, slopes / np.where(low, 1.0, response))
    nonlinear = _NONLINEAR * (1 - min(float(np.median(response)), 1.0))
    return slopes, limited, math.hypot(_GAIN_ERROR, nonlinear, share)


def _of_aot(path: Path) -> dict[str, Any]:
    from faintspot.io.aot_reading import read_aot

    sensor = read_aot(path)
    if sensor.slopes is None:
        raise InputError(f"{path}: expected slopes (measurements of the sensor), found none")
    values: dict[str, Any] = {
        "slopes": sensor.slopes.reshape(len(sensor.slopes), -1),
        "loop": "closed" if sensor.is_closed else "open",
    }
    if sensor.unit.lower() in _OF_AOT:
        values["slope_unit"] = _OF_AOT[sensor.unit.lower()]
    optional = {name: getattr(sensor, name) for name in _OF_SENSOR}
    optional |= {"time_s": sensor.unix_time_s, "interaction_matrix": sensor.interaction}
    return values | {name: value for name, value in optional.items() if value is not None and np.size(value)}


def _loop(name: str, values: dict[str, Any], given: list[str]) -> Recording:
    """Return the loop of values from files, checked."""
    if "slopes" not in values:
        raise InputError("slopes: expected an array, found none; name one with --slopes")
    slopes = real_array("slopes", values["slopes"], minimum_dimensions=1).astype(np.float64)
    remarks = [_taken(values, given), *values.get("remarks", ())]
    in_pairs = one_of("slope_order", values.get("slope_order", _AXES), _ORDERS) == _PAIRS
    if 2 not in slopes.shape[1:]:  # an image of one row, or a column
        slopes = rows_of_slopes(slopes)
    if in_pairs and slopes.ndim == 2:
        slopes = np.hstack([slopes[:, ::2], slopes[:, 1::2]])
    numbers = _numbers(values)
    if "slope_unit" not in values:
        raise InputError(f"slope_unit: unknown; give it with --slope-unit ({', '.join(UNITS)})")
    unit = one_of("slope_unit", values["slope_unit"], list(UNITS))
    scale = UNITS[unit] or numbers.pop("pixel_scale_arcsec", None)
    frame, rate = _timing(values, len(slopes), numbers.get("frame_rate_hz"))
    interaction = values.get("interaction_matrix")
    if interaction is None and values.get("control_matrix") is not None:
        control = finite_array("control_matrix", values["control_matrix"], minimum_dimensions=2)
        control = control.astype(np.float64)
        interaction = np.linalg.pinv(control.reshape(len(control), -1), rcond=0.03)
        remarks.append("interaction matrix: pseudo-inverse of the control matrix")
    if in_pairs and interaction is not None:
        matrix = finite_array("interaction_matrix", interaction, minimum_dimensions=2)
        interaction = np.vstack([matrix[::2], matrix[1::2]])
    n, cells = slopes[0].size // 2, values.get("cells")
    if cells is None and math.isqrt(n) ** 2 != n:
        raise InputError(
            f"cells: unknown; give a mask, or row and column of each of the {n} sub-apertures, with --cells; "
            f"--cells {_NO_CELLS} for a sensor without them"
        )
    has_cells = not (isinstance(cells, str) and cells == _NO_CELLS)
    diameter_m = numbers.pop("diameter_m", None)
    known: dict[str, Any] = {**numbers, "pixel_scale_arcsec": scale, "frame_rate_hz": rate}
    known |= {name: values.get(name) for name in OFFSETS}
    if in_pairs and known["reference_slopes"] is not None:
        known["reference_slopes"] = np.asarray(known["reference_slopes"]).reshape(-1, 2).T.ravel()
    loop = Recording(
        slopes,
        values.get("commands"),
        interaction,
        cells_of(cells, n) if has_cells else None,
        **known,
        frame=frame,
        flux=values.get("flux"),
        is_closed=one_of("loop", values.get("loop", "closed"), ("closed", "open")) == "closed",
        slope_unit=unit,
        name=name,
    )
    if has_cells:
        slopes, left_out = _usable(loop.slopes, values.get("flags"))
        remarks += [f"slopes: {left_out}"] if left_out else []
        side = side_m(loop.cells, loop.subaperture_m, diameter_m, values.get("flags"))
        loop = replace(loop, slopes=slopes, subaperture_m=side)
    return replace(loop, remarks=(*remarks, *_unknown(loop, values)))


def _taken(values: Mapping[str, Any], given: list[str]) -> str:
    """Return in one line what was taken from where."""
    sources = values.get("sources", {})
    names = [name for name in (*_ARRAYS, *NUMBERS) if name in values and name not in given]
    parts = [f"{name} from {sources[name]}" if name in sources else name for name in names]
    parts += [f"{name} as given" for name in given]
    law = f"; control law: {values['control_law']}" if "control_law" in values else ""
    return f"read as {values.get('origin', 'arrays')}: {', '.join(parts)}{law}"


def _unknown(loop: Recording, values: Mapping[str, Any]) -> list[str]:
    """Return in a line what could not be known, with the options that say it."""
    of_loop = () if loop.is_closed else ("commands", "interaction_matrix")
    unknown = [
        f"{name} ({option})"
        for name, option in _ASKED.items()
        if getattr(loop, name) is None and name not in of_loop
    ]
    if values.get("frame") is None and values.get("time_s") is None:
        unknown.append("lost frames")
    if loop.is_closed and "control_law" not in values:
        unknown.append("control law")
    return [f"not known: {', '.join(unknown)}"] if unknown else []


def _usable(slopes: Floats, flags: NDArray[np.uint8] | None) -> tuple[Floats, str]:
    """Return slopes (frames, 2 n) with NaN where they are not valid, and the line about these."""
    x, y = np.split(slopes, 2, axis=1)
    flags = np.zeros(x.shape, np.uint8) if flags is None else np.asarray(flags)
    if flags.shape != x.shape or flags.dtype.kind not in "ui":
        raise InputError(f"flags: expected integers of shape {x.shape}, got {flags.dtype} of {flags.shape}")
    valid, left_out = leave_out(flags, others={"not finite": ~np.isfinite(x + y)})
    return np.where(np.tile(valid, 2), slopes, np.nan), left_out


def _timing(values: Mapping[str, object], frames: int, rate: float | None) -> tuple[NDArray[np.int64], float]:
    """Return frame numbers and the frame rate."""
    time, frame = values.get("time_s"), values.get("frame")
    if frame is not None:
        frame = increasing("frame", frame, frames, integer=True)
    if time is not None:
        time = increasing("time_s", time, frames)
        rate = rate or frame_rate(time, frame)
    if rate is None or math.isnan(rate):
        raise InputError("frame_rate_hz: unknown; give it with --frame-rate-hz")
    if frame is None:
        frame = np.arange(frames) if time is None else np.rint((time - time[0]) * rate)
        frame = increasing("frame", frame, frames, integer=True)
    return frame, rate


def frame_rate(time_s: Floats, frame: NDArray[Any] | None = None) -> float:
    """Return the median frame rate over spans of up to 100 frames without a gap; NaN if it is not known.

    Time stamps of buffered frames lie close together. Without frame numbers, single intervals have to do.
    """
    number = np.arange(len(time_s)) if frame is None else frame
    for span in (1,) if frame is None else (100, 30, 10, 3, 1):
        whole = number[span:] - number[:-span] == span
        if whole.any():
            return float(span / np.median((time_s[span:] - time_s[:-span])[whole]))
    return math.nan
