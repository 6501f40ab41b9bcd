"""Telemetry in a layout of observatories and benches, or in arrays that are named one by one."""

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, errors_within
from faintspot.io.fits_units import units_of
from faintspot.io.formats.csv_files import TEXTS
from faintspot.io.frames import frame_format, read_array
from faintspot.io.stored_array import listed

_KECK_TICK_S = 1e-7


@dataclass(frozen=True, kw_only=True)
class TelemetryLayout:
    """Names of the quantities of a loop in one kind of files.

    Names are those of columns, fields or files; capitals do not count. They may be patterns with *, and
    alternatives with |.
    """

    name: str
    slopes: tuple[str, ...]
    """Arrays (frames, ...), side by side; a file of this kind has all of them."""
    columns: tuple[int | None, int | None] = (None, None)
    """First of their columns that are slopes, and the one after the last."""
    commands: tuple[str, ...] = ()
    """Arrays (frames, commands), side by side, of which some may be absent."""
    interaction: tuple[str, ...] = ()
    """Interaction matrix of each of these, in the file or in a file beside it."""
    identity: bool = False
    """Whether commands have the axes and the unit of the slopes."""
    control: str = ""
    """Control matrix, in rows for all commands, in the file or beside it; further rows follow."""
    cells: str = ""
    frame: str = ""
    time_s: Mapping[str, float] = field(default_factory=dict)
    """Arrays whose sum is the time, and the seconds in their units."""
    rate: str = ""
    """Frame rate [Hz] in the header."""
    closed: str = ""
    """State of the loop in the header."""
    law: str = ""
    """Keyword or array that describes the control law."""
    known: Mapping[str, Any] = field(default_factory=dict)
    """Values that all files of this kind have: slope_order, slope_unit, subaperture_m, cells."""


def _keck_cells() -> NDArray[np.int64]:
    """Return the mask of the 304 sub-apertures of Keck's sensor."""
    mask = np.zeros((20, 20), np.int64)
    for row, width in enumerate((6, 10, 14, 16, 16, 18, 18, 20, 20, 20)):
        mask[[row, 19 - row], 10 - width // 2 : 10 + width // 2] = 1
    mask[8:12, 9:11] = mask[9:11, 8:12] = 0  # the secondary mirror
    return mask


LAYOUTS: tuple[TelemetryLayout, ...] = (
    TelemetryLayout(
        name="SPARTA table",
        slopes=("Gradients",),
        # CIAO and SPHERE, with the tip-tilt mirror; ERIS; GPAO; NAOMI, whose matrix is that of modes; others
        commands=(
            "HODM_Positions|DSM_Positions|DM_Positions|ModalCoefficients|*_Positions|Positions",
            "ITTM_Positions",
        ),
        interaction=("*HO_IM*|*SynthIMComp.IM*|ModalRecnCalibrat.REF_IM*|*SYNTHETIC_*IM*", "*ITT_IM*"),
        control="*REC1.CM*|*REC1.HOCM*",
        frame="FrameCounter",
        time_s={"Seconds": 1.0, "USeconds": 1e-6},
        rate="ESO AOS LOOP RATE",
        closed="ESO AOS HO LOOP ST|ESO AOS LOOP ST",
        law="ESO AOS GLOBAL GAIN",
        known={"slope_order": "pairs"},
    ),
    TelemetryLayout(
        name="Keck save file, high order",
        slopes=("A.OFFSETCENTROID",),
        commands=("A.DMCOMMAND", "A.TTCOMMANDS"),
        control="RX",
        time_s={"A.TIMESTAMP": _KECK_TICK_S},
        law="DM_SERVO",
        known={
            "slope_order": "pairs",
            "slope_unit": "px",
            "subaperture_m": 0.5625,
            "cells": _keck_cells(),
        },
    ),
    TelemetryLayout(
        name="Keck save file, tip-tilt sensor",
        slopes=("B.DTTCENTROIDS",),
        commands=("B.DTTCOMMANDS",),
        identity=True,
        time_s={"B.TIMESTAMP": _KECK_TICK_S},
        law="DT_SERVO",
    ),
    TelemetryLayout(
        name="Keck save file, tip and tilt of the wavefront sensor",
        slopes=("A.RESIDUALWAVEFRONT",),
        columns=(-3, -1),  # after the actuators and before focus
        commands=("A.TTCOMMANDS",),
        identity=True,
        time_s={"A.TIMESTAMP": _KECK_TICK_S},
        law="DT_SERVO",
        known={"slope_unit": "arcsec"},
    ),
    TelemetryLayout(
        name="folder of ciao",
        slopes=("x_slopes", "y_slopes"),
        commands=("commands",),
        interaction=("*poke*",),
        cells="*mask*",
        time_s={"time_s": 1.0},
        known={"slope_unit": "rad"},
    ),
    TelemetryLayout(
        name="folder of arrays",
        slopes=("slopes",),
        interaction=("interaction_matrix|*poke*",),
        commands=("commands",),
        control="control_matrix",
        cells="cells|*mask*",
        frame="frame",
        time_s={"time_s": 1.0},
    ),
)
"""Known layouts; no two have the same slopes."""


_TABLES = (".fits.gz", ".fits", ".sav")
_ENDINGS = (*_TABLES, ".fits.fz", ".npy", *TEXTS)
_MOST_FILES = 1 << 14
_OPEN = ("F", "FALSE", "NO", "OFF", "OPEN", "OPENED")

Names = Mapping[str, str]  # locations for `read_array`, by the names of arrays


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
    names, chosen = _names(path), named.get("slopes")
    layouts = _fitting(names)
    if path.is_dir() and not layouts and not _find(names, chosen or ""):
        files = [file for file in _files(path) if file.name.lower().endswith(_TABLES)]
        tables = [file for file in files if _fitting(_names(file))]
        if len(tables) == 1:
            return read_layout(tables[0], named)
        if tables:
            names_of = listed(file.name for file in tables)
            raise InputError(f"{path}: expected one table of a loop; name one as FILE: {names_of}")
    if chosen is not None:
        layouts = [layout for layout in layouts if chosen.upper() == layout.slopes[0].upper()]
        layouts = layouts or _timed(names, chosen)
    if len(layouts) > 1:
        choices = listed(layout.slopes[0] for layout in layouts)
        raise InputError(f"{path}: has {len(layouts)} loops; choose one with --slopes: {choices}")
    values: dict[str, Any] = {"origin": "arrays", "sources": {}}
    if layouts:
        layout = layouts[0]
        if named.keys() & {"commands", "interaction_matrix", "control_matrix"}:  # no matrix but the named one
            layout = replace(layout, interaction=(), control="", identity=False)
        values = _Reader(path, names, layout).values()
    elif chosen is None and (path.is_dir() or len(names) > 1):
        raise InputError(
            f"{path}: expected a known layout of telemetry; name an array with --slopes, and one with "
            f"--commands: {listed(names)}"
        )
    elif chosen is None:
        values["slopes"] = read_array(path)
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
    """Return the files of arrays in a folder, sorted; refuse a folder with too many."""
    files = [file for file in folder.iterdir() if file.name.lower().endswith(_ENDINGS) and file.is_file()]
    if len(files) > _MOST_FILES:
        raise InputError(f"{folder}: expected at most {_MOST_FILES:,} files, got {len(files):,}; name one")
    return sorted(files)


def _stem(file: Path) -> str:
    ending = next(ending for ending in _ENDINGS if file.name.lower().endswith(ending))
    return file.name[: -len(ending)]


def _fitting(names: Names) -> list[TelemetryLayout]:
    return [layout for layout in LAYOUTS if all(_find(names, name) for name in layout.slopes)]


def _timed(names: Names, slopes: str) -> list[TelemetryLayout]:
    """Return the layout of slopes that are named, with numbers and times of the frames as in a known one."""
    if not _find(names, slopes):
        return []
    own = TelemetryLayout(name="arrays", slopes=(slopes,))
    for known in LAYOUTS:
        if all(_find(names, name) for name in (known.frame, *known.time_s) if name):
            return [replace(own, frame=known.frame, time_s=known.time_s, rate=known.rate)]
    return [own]


def _find(names: Iterable[str], patterns: str, beside: str = "") -> str:
    """Return a name that fits the first possible of some patterns, "" if none does.

    Of several names the first one is taken that ends with the number of a file, else the first one.
    """
    number = re.search(r"(_\d+)?$", beside)[0]  # type: ignore[index]
    for pattern in patterns.upper().split("|"):
        found = sorted(name for name in names if fnmatchcase(name.upper(), pattern))
        if found:
            return next((name for name in found if name.endswith(number)), found[0])
    return ""


def _located(path: Path, names: Names, text: str) -> str:
    """Return the location of an array that an option names."""
    if name := _find(names, text):
        return names[name]
    for folder in (Path(), path if path.is_dir() else path.parent):
        whole = folder / text
        if whole.exists() or Path(f"{whole}".rpartition(":")[0]).is_file():
            return f"{whole}"
    if names:
        raise InputError(f"{text}: expected a file, or an array of {path}: {listed(names)}")
    return f"{path}:{text}"


def _rising(frame: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the rows whose frame number is larger than all before."""
    return np.append(True, frame[1:] > np.maximum.accumulate(frame)[:-1])


def _is_open(state: str) -> bool:
    """Return whether the state of a loop in a header, a word or a number, is that of an open one."""
    with suppress(ValueError):
        return float(state) == 0.0
    return state.strip().upper() in _OPEN


class _Reader:
    """Reader of one loop."""

    def __init__(self, path: Path, names: Names, layout: TelemetryLayout) -> None:
        beside = {} if path.is_dir() else _names(path.parent)
        self._path, self._names, self._layout, self._all = path, names, layout, {**beside, **names}
        is_fits = path.is_file() and frame_format(path).name == "FITS"
        self._headers = [unit.header for unit in units_of(path)] if is_fits else []
        self._sources: dict[str, str] = {}
        self._remarks: list[str] = []

    def values(self) -> dict[str, Any]:
        """Return the quantities; see `read_layout`."""
        layout = self._layout
        if len(layout.slopes) == 1:  # perhaps (frames, n, 2)
            slopes = self._read("slopes", _find(self._names, layout.slopes[0]))
        else:
            slopes = self._side_by_side("slopes", layout.slopes)
        if slopes.ndim == 2:
            slopes = slopes[:, slice(*layout.columns)]
        commands = self._commands(slopes.size // max(len(slopes), 1))
        values = {**layout.known, "slopes": slopes, **commands, **self._timing()}
        if cells := _find(self._all, layout.cells):
            values["cells"] = self._read("cells", cells)
        if (state := self._stated(layout.closed)) is not None:
            values["loop"] = "open" if _is_open(str(state)) else "closed"
        if (law := self._stated(layout.law)) is not None:
            values["control_law"] = f"{layout.law} = {law}"
        frame = values.get("frame", ())
        if len(frame) == len(slopes):
            kept = _rising(frame)
            if not kept.all():
                count = np.count_nonzero(~kept)
                self._remarks.append(f"frame: left out {count} rows whose number does not rise")
            rows = ("slopes", "commands", "frame", "time_s")
            values |= {name: values[name][kept] for name in rows if len(values.get(name, ())) == len(kept)}
        return {**values, "origin": layout.name, "sources": self._sources, "remarks": self._remarks}

    def _read(self, quantity: str, name: str) -> NDArray[Any]:
        """Read an array of the file or beside it, and note where it is from."""
        is_inside = name in self._names and not self._path.is_dir()
        source = name if is_inside else Path(self._all[name]).name
        self._sources[quantity] = ", ".join(filter(None, [self._sources.get(quantity), source]))
        return read_array(self._all[name])

    def _side_by_side(self, quantity: str, names: Iterable[str]) -> NDArray[Any]:
        """Read arrays of the file as one, (frames, values)."""
        arrays = [self._read(quantity, _find(self._names, name)) for name in names]
        if len({len(array) for array in arrays}) > 1:
            lengths = ", ".join(f"{len(array)}" for array in arrays)
            raise InputError(f"{self._sources[quantity]}: expected arrays of as many frames, got {lengths}")
        return np.hstack([array.reshape(len(array), -1) for array in arrays])

    def _commands(self, width: int) -> dict[str, Any]:
        """Return commands and their matrix; those without a matrix are left out if others have one."""
        layout, stem = self._layout, self._path.name.partition(".")[0]
        pairs = zip_longest(layout.commands, layout.interaction, fillvalue="")
        matrices = {_find(self._names, name): _find(self._all, matrix, stem) for name, matrix in pairs}
        matrices.pop("", None)
        known = {name: matrix for name, matrix in matrices.items() if matrix}
        control = _find(self._all, layout.control, stem)
        if len(known) > 0 and (len(known) == len(matrices) or not control):
            for name in matrices.keys() - known:
                self._remarks.append(f"commands: {name} left out, as there is no matrix for it")
            commands = self._side_by_side("commands", known)
            return {"commands": commands, **self._interaction(known.values(), width, commands.shape[1])}
        values = {"commands": self._side_by_side("commands", matrices)} if matrices else {}
        if matrices and layout.identity:
            self._sources["interaction_matrix"] = "an assumed identity"
            values["interaction_matrix"] = np.eye(width)
        elif matrices and control:
            values["control_matrix"] = self._control(control, width, values["commands"].shape[1])
        return values

    def _interaction(self, names: Iterable[str], width: int, commands: int) -> dict[str, Any]:
        """Return the interaction matrices of arrays of commands as one."""
        found = [np.atleast_2d(self._read("interaction_matrix", name).squeeze()) for name in names]
        blocks = [block if len(block) == width else block.T for block in found]
        if any(len(block) != width for block in blocks) or sum(len(block.T) for block in blocks) != commands:
            raise InputError(
                f"{self._sources['interaction_matrix']}: expected shape {(width, commands)}, got "
                f"{', '.join(str(block.shape) for block in found)}; name another with --interaction-matrix"
            )
        return {"interaction_matrix": np.hstack(blocks)}

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
        """Return frame numbers, and times, else the rate of the header, as far as these are recorded."""
        layout, values = self._layout, dict[str, Any]()
        if frame := _find(self._names, layout.frame):
            values["frame"] = self._read("frame", frame).reshape(-1).astype(np.int64)
        units = {name: unit for own, unit in layout.time_s.items() if (name := _find(self._names, own))}
        parts = self._side_by_side("time_s", units) if units else np.zeros((2, 0))
        if parts.shape[1] != len(units):
            raise InputError(f"{self._sources['time_s']}: expected a number for each frame, got more")
        time_s = parts @ list(units.values())
        frames = values.get("frame", ())
        if (np.diff(time_s[_rising(frames)] if len(frames) == len(time_s) else time_s) > 0).all():
            return {**values, "time_s": time_s}
        if names := self._sources.pop("time_s", ""):
            self._remarks.append(f"times: {names} do not rise, so they are not used")
        if (rate := self._stated(layout.rate)) is not None:
            values["frame_rate_hz"] = rate
            self._sources["frame_rate_hz"] = layout.rate
        return values

    def _stated(self, patterns: str) -> Any:
        """Return what the headers say, or an array as text; None if neither does."""
        for name in filter(None, patterns.split("|")):
            for header in self._headers:
                if name in header:
                    return header[name]
        found = _find(self._names, patterns)
        return " ".join(f"{value:g}" for value in read_array(self._names[found]).flat[:16]) if found else None
