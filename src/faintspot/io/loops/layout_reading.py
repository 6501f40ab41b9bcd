"""Telemetry in one of the known layouts, or in arrays that are named one by one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, errors_within
from faintspot.io.arrays.fits_units import units_of
from faintspot.io.formats.csv_files import TEXTS
from faintspot.io.formats.registry import frame_format
from faintspot.io.frames import read_array
from faintspot.io.loops.layouts import LAYOUTS, TelemetryLayout

_ENDINGS = (".fits", ".fits.gz", ".fits.fz", ".sav", ".npy", *TEXTS)
_MOST_FILES = 1 << 14
_NAMED = 12  # arrays in a message
_OPEN = ("F", "OPEN", "OFF", "0")

Names = Mapping[str, str]
"""Locations for `read_array`, by the names of arrays."""


def read_layout(path: Path, named: Mapping[str, str]) -> dict[str, Any]:
    """Read the quantities of a loop from a file or a folder.

    Parameters
    ----------
    path : path
        A file with named arrays (tables in FITS files, IDL's .sav) or one array, or a folder of files.
    named : mapping
        Quantities (slopes, commands, interaction_matrix, ...) and the array that holds each, in place of that
        of the layout: a name in the file or folder, or a file.

    Returns
    -------
    dict
        Arrays and numbers by quantity; "origin": the layout; "sources": what was taken from where; "remarks";
        "control_law" where it is recorded.

    Raises
    ------
    InputError
        When the arrays are not of a known layout and the slopes are not named, of several loops none is
        chosen, or a file is damaged.
    """
    names = _names(path)
    layouts = _fitting(names)
    chosen = named.get("slopes")
    if chosen is not None:
        layouts = [layout for layout in layouts if chosen.upper() in map(str.upper, layout.slopes)]
    if path.is_dir() and not layouts and chosen is None:
        tables = [file for file in _files(path) if _is_named(file) and _fitting(_names(file))]
        if len(tables) == 1:
            return read_layout(tables[0], named)
        if tables:
            raise InputError(f"{path}: expected one table of a loop; name one as FILE: {_listed(tables)}")
    if len(layouts) > 1:
        slopes = [layout.slopes[0] for layout in layouts]
        raise InputError(f"{path}: has {len(slopes)} loops; choose one with --slopes: {_listed(slopes)}")
    if layouts:
        values = _Reader(path, names, layouts[0]).values()
    elif chosen is not None and chosen.upper() in map(str.upper, names):
        values = _Reader(path, names, _timed(names, chosen)).values()
    elif chosen is not None:
        values = {"origin": "arrays", "sources": {}}
    elif path.is_dir() or len(names) > 1:
        raise InputError(
            f"{path}: expected a known layout of telemetry; name an array with --slopes, and one with "
            f"--commands: {_listed(names) or 'none'}"
        )
    else:
        values = {"slopes": read_array(path), "origin": "one array", "sources": {}}
    for quantity, text in named.items():
        if quantity != "slopes" or "slopes" not in values:
            with errors_within(f"--{quantity.replace('_', '-')}"):
                values[quantity] = read_array(_located(path, names, text))
            values["sources"][quantity] = text
    return values


def _names(path: Path) -> dict[str, str]:
    """Return the arrays of a file, or the files of arrays in a folder."""
    if path.is_dir():
        return {_stem(file): f"{file}" for file in _files(path)}
    return {name: f"{path}:{name}" for name in frame_format(path).names(path)}


def _files(folder: Path) -> list[Path]:
    """Return the files of arrays in a folder, sorted.

    Raises
    ------
    InputError
        When it has too many files.
    """
    files = []
    for number, file in enumerate(folder.iterdir()):
        if number >= _MOST_FILES:
            raise InputError(f"{folder}: expected at most {_MOST_FILES:,} files; name one as FILE")
        if file.name.lower().endswith(_ENDINGS) and file.is_file():
            files.append(file)
    return sorted(files)


def _is_named(file: Path) -> bool:
    """Return whether a file may hold a table of a loop."""
    return file.name.lower().endswith((".fits", ".fits.gz", ".sav"))


def _stem(file: Path) -> str:
    ending = next(
        ending for ending in sorted(_ENDINGS, key=len, reverse=True) if file.name.lower().endswith(ending)
    )
    return file.name[: -len(ending)]


def _fitting(names: Names) -> list[TelemetryLayout]:
    """Return the layouts that arrays have, one for each set of slopes."""
    fitting: dict[tuple[str, ...], TelemetryLayout] = {}
    for layout in LAYOUTS:
        if all(_matches(names, name) for name in (*layout.slopes, *layout.commands[:1])):
            fitting.setdefault(layout.slopes, layout)
    # Slopes without commands, in a layout with any.
    for layout in LAYOUTS:
        if all(_matches(names, name) for name in layout.slopes):
            fitting.setdefault(layout.slopes, replace(layout, commands=()))
    return list(fitting.values())


def _timed(names: Names, slopes: str) -> TelemetryLayout:
    """Return the layout of slopes that are named, with numbers and times of the frames as in a known one."""
    for layout in LAYOUTS:
        if layout.time_s and all(_matches(names, name) for name in layout.time_s):
            return TelemetryLayout(
                name="arrays",
                slopes=(slopes,),
                frame=layout.frame,
                time_s=layout.time_s,
                rate=layout.rate,
                closed=layout.closed,
            )
    return TelemetryLayout(name="arrays", slopes=(slopes,))


def _matches(names: Names, patterns: str, beside: str = "") -> list[str]:
    """Return the names of the first of some patterns that fits any, those with the number of a file first."""
    for pattern in patterns.split("|"):
        found = [name for name in names if pattern and fnmatchcase(name.upper(), pattern.upper())]
        if found:
            number = re.search(r"_\d+$", beside)
            return sorted(found, key=lambda name: (number is not None and not name.endswith(number[0]), name))
    return []


def _located(path: Path, names: Names, text: str) -> str:
    """Return the location of an array that an option names."""
    same = [location for name, location in names.items() if name.upper() == text.upper()]
    if same:
        return same[0]
    for folder in (Path(), path if path.is_dir() else path.parent):
        whole = folder / text
        if whole.exists() or (":" in text and Path(f"{whole}".rpartition(":")[0]).is_file()):
            return f"{whole}"
    return text if path.is_dir() or names else f"{path}:{text}"


def _listed(names: Any) -> str:
    texts = [name.name if isinstance(name, Path) else name for name in names]
    more = f" and {len(texts) - _NAMED} more" if len(texts) > _NAMED else ""
    return f"{', '.join(texts[:_NAMED])}{more}"


class _Reader:
    """Reader of one loop."""

    def __init__(self, path: Path, names: Names, layout: TelemetryLayout) -> None:
        folder = path if path.is_dir() else path.parent
        beside = {} if path.is_dir() else {_stem(file): f"{file}" for file in _files(folder) if file != path}
        self._path, self._names, self._layout, self._all = path, names, layout, {**beside, **names}
        self._sources: dict[str, str] = {}
        self._remarks: list[str] = []

    def values(self) -> dict[str, Any]:
        """Return the quantities; see `read_layout`."""
        layout = self._layout
        slopes = _side_by_side({name: self._rows(name) for name in layout.slopes})[:, slice(*layout.columns)]
        values: dict[str, Any] = {**layout.known, "slopes": slopes}
        self._sources["slopes"] = ", ".join(layout.slopes)
        values |= self._commands(slopes.shape[1])
        values |= self._timing()
        if cells := _matches(self._all, layout.cells):
            values["cells"] = self._read("cells", cells[0])
        described = dict(self._described())
        if (state := described.get(layout.closed)) is not None:
            values["loop"] = "open" if str(state).strip().upper() in _OPEN or state is False else "closed"
        if "frame_rate_hz" not in values and (rate := described.get(layout.rate)) is not None:
            values["frame_rate_hz"] = rate
            self._sources["frame_rate_hz"] = layout.rate
        law = [f"{name} = {described[name]}" for name in layout.law if name in described]
        values |= {"control_law": "; ".join(law)} if law else {}
        frame = values.get("frame")
        if frame is not None and len(frame) == len(slopes):
            kept = np.append(True, frame[1:] > np.maximum.accumulate(frame)[:-1])
            if not kept.all():
                self._remarks.append(
                    f"frame: left out {np.count_nonzero(~kept)} rows whose number does not rise"
                )
                rows = ("slopes", "commands", "frame", "time_s")
                values |= {
                    name: values[name][kept] for name in rows if len(values.get(name, ())) == len(kept)
                }
        return {**values, "origin": layout.name, "sources": self._sources, "remarks": self._remarks}

    def _read(self, quantity: str, name: str) -> NDArray[Any]:
        """Read an array and note where it is from."""
        location = self._all[name]
        inside = name in self._names and not self._path.is_dir()
        self._sources[quantity] = name if inside else Path(location).name
        return read_array(location)

    def _rows(self, name: str) -> NDArray[Any]:
        """Return an array of the file as (frames, values)."""
        array = read_array(self._names[_matches(self._names, name)[0]])
        return array.reshape(len(array), -1)

    def _commands(self, width: int) -> dict[str, Any]:
        """Return commands, and the matrix for as many of them as there is one for."""
        present = {name: found[0] for name in self._layout.commands if (found := _matches(self._names, name))}
        if not present:
            return {}
        arrays = {name: self._rows(name) for name in present}
        matrices = self._interactions(arrays, width)
        values: dict[str, Any] = {}
        control = _matches(self._all, self._layout.control, self._path.stem.partition(".")[0])
        if len(matrices) < len(arrays) and control:
            values["control_matrix"] = self._control(control[0], width, sum(map(_width, arrays.values())))
        elif matrices:
            for name in [name for name in arrays if name not in matrices]:
                self._remarks.append(f"commands: {present[name]} left out, as there is no matrix for it")
                del arrays[name]
            values["interaction_matrix"] = np.hstack([matrices[name] for name in arrays])
        if "control_matrix" in values:
            self._sources.pop("interaction_matrix", None)
        self._sources["commands"] = ", ".join(present[name] for name in arrays)
        return {**values, "commands": _side_by_side(arrays)}

    def _interactions(self, arrays: Mapping[str, NDArray[Any]], width: int) -> dict[str, NDArray[Any]]:
        """Return the interaction matrices (slopes, commands) of arrays of commands that have one."""
        if self._layout.identity:
            self._sources["interaction_matrix"] = "identity"
            return {name: np.eye(width) for name in arrays}
        matrices, files = {}, []
        for name, commands in arrays.items():
            found = _matches(
                self._all, self._layout.interaction.get(name, ""), self._path.stem.partition(".")[0]
            )
            if not found:
                continue
            matrix = self._read("interaction_matrix", found[0]).squeeze()
            files.append(self._sources["interaction_matrix"])
            shape = width, _width(commands)
            matrix = matrix.T if matrix.shape == shape[::-1] else matrix
            if matrix.shape != shape:
                raise InputError(
                    f"{self._all[found[0]]}: expected shape {shape}, got {matrix.shape}; name another with "
                    "--interaction-matrix"
                )
            matrices[name] = matrix
            self._sources["interaction_matrix"] = ", ".join(files)
        return matrices

    def _control(self, name: str, width: int, commands: int) -> NDArray[Any]:
        """Return the rows of a control matrix for commands."""
        matrix = self._read("control_matrix", name)
        if matrix.size % width or matrix.size < commands * width:
            raise InputError(
                f"{self._all[name]}: expected at least {commands} rows of {width}, got shape {matrix.shape}; "
                "name another with --control-matrix"
            )
        return matrix.reshape(-1, width)[:commands]

    def _timing(self) -> dict[str, Any]:
        """Return frame numbers and times, as far as these are recorded."""
        layout, values = self._layout, dict[str, Any]()
        if frame := _matches(self._names, layout.frame):
            values["frame"] = self._read("frame", frame[0]).reshape(-1).astype(np.int64)
        parts = {
            found[0]: unit for name, unit in layout.time_s.items() if (found := _matches(self._names, name))
        }
        if parts:
            time = _side_by_side({name: self._rows(name) * unit for name, unit in parts.items()}).sum(axis=1)
            if (np.diff(time) > 0).all():
                values["time_s"] = time
                self._sources["time_s"] = ", ".join(parts)
            else:
                self._remarks.append(f"times: {', '.join(parts)} do not rise, so they are not used")
        return values

    def _described(self) -> Iterator[tuple[str, Any]]:
        """Yield what headers or arrays say of rate, state and control law, by the layout's names."""
        layout = self._layout
        units = [] if self._path.is_dir() else _headers(self._path)
        for wanted in (layout.rate, layout.closed, *layout.law):
            for name in wanted.split("|"):
                for header in units:
                    if name and name in header:
                        yield wanted, header[name]
            if wanted in layout.law and (found := _matches(self._names, wanted)):
                yield (
                    wanted,
                    " ".join(f"{value:g}" for value in read_array(self._names[found[0]]).ravel()[:16]),
                )


def _headers(path: Path) -> list[Any]:
    """Return the headers of a FITS file; of another file none."""
    if frame_format(path).name != "FITS":
        return []
    return [unit.header for unit in units_of(path)]


def _side_by_side(arrays: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return arrays (frames, ...) as one."""
    if len({len(array) for array in arrays.values()}) > 1:
        listed = ", ".join(f"{len(array)} of {name}" for name, array in arrays.items())
        raise InputError(f"expected arrays of as many frames, got {listed}")
    return np.hstack(list(arrays.values()))


def _width(array: NDArray[Any]) -> int:
    return int(array.shape[1])
