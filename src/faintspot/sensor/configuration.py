"""One TOML file (faintspot.toml) for layout, calibration and settings: a table for each.

Maps of a calibration are kept beside it, in NAME.calibration.npz, and named in the TOML file.
"""

from __future__ import annotations

import difflib
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError

from faintspot.errors import InputError
from faintspot.io.frames import read_array
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.sensor.settings import PER_SUBAPERTURE, PerSubaperture, Settings

TABLES: dict[str, type] = {
    "layout": Layout,
    "calibration": Calibration,
    "settings": Settings,
    "psf": PSF,
    "score": TrainedScore,
}
_FILED: dict[str, type[PSF] | type[TrainedScore]] = {
    "psf": PSF,
    "score": TrainedScore,
}  # kept in files of their own, which the table names
GRID_KEYS = ("shape", "pixels", "outer_radius", "inner_radius", "pitch", "origin", "frame_shape")
ANALYTIC_KEYS = ("profile", "size", "elongation", "angle_deg", "radius_px")
# Settings that a reader of the file looks for, also where they are at their defaults; the second ones only
# where denoising or brightest pixels have a say.
_ALWAYS_WRITTEN = ("estimator", "flux_floor", "max_bad_fraction")
_WRITTEN_FOR_GRAVITY = (
    "noise_std",
    "tolerance",
    "max_iterations",
    "keep_brightest",
    "rule",
    "denoise",
    "algorithm",
    "preset",
)
_CALIBRATION_MAPS = ("dark", "flat", "bad_pixels")


def load(path: str | Path, table: str) -> Any:
    """Read one table of a configuration file as the object it describes.

    Parameters
    ----------
    path : path
    table : {"layout", "calibration", "settings"}

    Returns
    -------
    Layout, Calibration or Settings
        A file without a calibration table gives `Calibration()`.

    Raises
    ------
    InputError
        When the file cannot be read, is not TOML, lacks the table, or has an unknown key or a bad value.
    """
    path = Path(path)
    return _build(path, table, _read(path))


class Configuration(NamedTuple):
    """Everything that a configuration file describes."""

    layout: Layout
    settings: Settings
    calibration: Calibration
    psf: PSF | None
    score: TrainedScore | None


def load_all(path: str | Path) -> Configuration:
    """Read everything from a configuration file; PSF and score may be absent."""
    path = Path(path)
    document = _read(path)
    return Configuration(
        _build(path, "layout", document),
        _build(path, "settings", document),
        _build(path, "calibration", document),
        _build(path, "psf", document) if "psf" in document else None,
        _build(path, "score", document) if "score" in document else None,
    )


def has(path: str | Path, table: str) -> bool:
    """Say whether a configuration file exists and has a table.

    Raises
    ------
    InputError
        When the file exists and cannot be read, or is not TOML.
    """
    path = Path(path)
    return path.exists() and table in _read(path)


def save(path: str | Path, item: Layout | Calibration | Settings | PSF | TrainedScore) -> None:
    """Write an object into its table of a configuration file; other tables and comments stay as they are.

    Raises
    ------
    InputError
        When the file exists and is not TOML, or cannot be written.
    """
    path = Path(path)
    table = next(name for name, kind in TABLES.items() if isinstance(item, kind))
    document = _parse(path) if path.exists() else tomlkit.document()
    if isinstance(item, PSF | TrainedScore):
        store = path.with_suffix(f".{table}.npz")
        item.save(store)
        values: dict[str, Any] = {"file": store.name}
    else:
        values = _values(item)
    maps = {key: value for key, value in values.items() if table == "calibration" and _is_map(value)}
    store = path.with_suffix(".calibration.npz")
    values.update({key: f"{store.name}:{key}" for key in maps})
    document[table] = _toml_table(values)
    try:
        if maps:
            np.savez_compressed(store, **maps)
        partial = path.with_name(f".{path.name}.partial")
        partial.write_text(tomlkit.dumps(document), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None


def to_text(*items: Layout | Calibration | Settings) -> str:
    """Return the configuration as TOML text; maps of a calibration are given by their shape only."""
    document = tomlkit.document()
    for item in items:
        table = next(name for name, kind in TABLES.items() if isinstance(item, kind))
        values = _values(item)
        if table == "calibration":
            values = {
                key: f"map of {value.shape}" if _is_map(value) else value for key, value in values.items()
            }
        document[table] = _toml_table(values)
    return tomlkit.dumps(document)


# Reading ---------------------------------------------------------------------------------------------


def _parse(path: Path) -> tomlkit.TOMLDocument:
    try:
        return tomlkit.parse(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; `faintspot layout FRAME -o {path.name}` makes one") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (TOMLKitError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a TOML file: {str(error).splitlines()[0]}") from None


def _read(path: Path) -> dict[str, Any]:
    """The file as plain dictionaries, with unknown tables refused."""
    document: dict[str, Any] = _parse(path).unwrap()
    for name in document:
        _known(f"{path}: ", name, list(TABLES), "table")
    return document


def _build(path: Path, table: str, document: dict[str, Any]) -> Any:
    if table not in document:
        if table == "calibration":
            return Calibration()
        raise InputError(f"{path}: expected a table [{table}], found {', '.join(document) or 'none'}")
    values = document[table]
    if not isinstance(values, dict):
        raise InputError(f"{path}: {table}: expected a table, got {values!r}")
    try:
        if table == "layout" and "grid" in values:
            return _grid(values)
        kind = TABLES[table]
        if table in _FILED:
            return _filed(path, table, values)
        for key in values:
            _known(f"{table}.", key, [f.name for f in fields(kind)], "key")
        required = [f.name for f in fields(kind) if f.default is MISSING]
        for key in required:
            if key not in values:
                raise InputError(f"{table}.{key}: expected a value, found none")
        if table == "calibration":
            values = {key: _map_or_value(path, key, value) for key, value in values.items()}
        if table == "settings":
            values = {key: _per_subaperture(key, value) for key, value in values.items()}
        return kind(**values)
    except InputError as error:
        text = str(error)
        where = "" if text.startswith((f"{table}.", f"{table}:")) else f"{table}."
        raise InputError(f"{path}: {where}{text}") from None


def _filed(path: Path, table: str, values: dict[str, Any]) -> Any:
    """A PSF or a score, from the file that the table names; or an analytic PSF."""
    if table == "psf" and "profile" in values:
        for key in values:
            _known("psf.", key, ANALYTIC_KEYS, "key beside profile")
        return PSF.analytic(**values)
    for key in values:
        _known(f"{table}.", key, ["file", "profile"] if table == "psf" else ["file"], "key")
    name = values.get("file")
    if not isinstance(name, str):
        raise InputError(f"{table}.file: expected the name of a file, found {name!r}")
    return _FILED[table].load(path.parent / name)


def _grid(values: dict[str, Any]) -> Layout:
    """A layout given as [layout.grid] with the arguments of Layout.grid."""
    for key in values:
        _known("layout.", key, ["grid"], "key beside grid")
    grid = values["grid"]
    if not isinstance(grid, dict):
        raise InputError(f"layout.grid: expected a table, got {grid!r}")
    for key in grid:
        _known("layout.grid.", key, GRID_KEYS, "key")
    for key in ("shape", "pixels"):
        if key not in grid:
            raise InputError(f"layout.grid.{key}: expected a value, found none")
    try:
        return Layout.grid(**grid)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith("layout") else f"layout.grid.{text}") from None


def _known(prefix: str, name: str, known: Any, what: str) -> None:
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
        raise InputError(f"{prefix}{name}: unknown {what}; {hint}")


def _map_or_value(path: Path, key: str, value: Any) -> Any:
    """A calibration map named by its file, relative to the configuration."""
    if key in _CALIBRATION_MAPS and isinstance(value, str):
        array = read_array(str(path.parent / value))
        return (
            array.astype(bool) if key == "bad_pixels" and array.ndim == 2 and array.shape[1] != 2 else array
        )
    return value


def _per_subaperture(key: str, value: Any) -> Any:
    """{ default = 2.5, 4 = 3.0 } as a value for some sub-apertures and a default for the others."""
    if not isinstance(value, dict) or key not in PER_SUBAPERTURE:
        return value
    others = {}
    for index, item in value.items():
        if index == "default":
            continue
        if not index.isdecimal():
            raise InputError(f"settings.{key}.{index}: expected default or the number of a sub-aperture")
        others[int(index)] = item
    return PerSubaperture(value.get("default"), others)


# Writing ---------------------------------------------------------------------------------------------


def _is_map(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray) and value.ndim == 2 and (value.shape[1] != 2 or value.dtype.kind != "i")
    )


def _values(item: Any) -> dict[str, Any]:
    """The fields that are not at their default, and those that are always written."""
    values = {}
    for f in fields(item):
        value = getattr(item, f.name)
        at_default = f.default is not MISSING and not isinstance(value, np.ndarray) and value == f.default
        always = isinstance(item, Settings) and (
            f.name in _ALWAYS_WRITTEN or (f.name in _WRITTEN_FOR_GRAVITY and item.estimator == "cog")
        )
        if value is not None and (always or not at_default):
            values[f.name] = value
    return values


def _toml_table(values: dict[str, Any]) -> Any:
    table = tomlkit.table()
    for key, value in values.items():
        table[key] = _toml_value(value)
    return table


def _toml_value(value: Any) -> Any:
    if isinstance(value, PerSubaperture):
        inline = tomlkit.inline_table()
        if value.default is not None:
            inline["default"] = value.default
        for index, item in value.others.items():
            inline[str(index)] = item
        return inline
    if isinstance(value, np.ndarray):
        # Rows are positions in pixels: a millionth is enough, and stays readable.
        rows = np.round(value, 6).tolist() if value.ndim == 2 else value.tolist()
        array = tomlkit.array()
        array.extend(rows)
        return array.multiline(value.ndim == 2)
    return list(value) if isinstance(value, tuple) else value
