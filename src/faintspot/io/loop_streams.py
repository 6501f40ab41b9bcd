"""Streams of slopes and commands that milk (CACAO) and pyRTC have recorded.

As https://github.com/oguyon/milk-streamtelemetry-scan describes (TelemetryFormat.md), STREAM_TIME.fits holds
(frames, height, width). STREAM_TIME.txt has for each frame its index, the main index, the time since the
beginning, the times of logging and of acquisition in seconds, and two counters.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_bytes, check_regular, memory_bytes
from faintspot.base.text_files import parse_json
from faintspot.io.frames import read_array
from faintspot.io.stored_array import listed

_ENDING = re.compile(r"\.fits(\.fz|\.gz)?$")
_STAMP = re.compile(r"_\d\d:\d\d:\d\d(\.\d+)?$")
_LOGGED, _ACQUIRED, _COUNTER, _COLUMNS = 3, 4, 5, 7


class Stream(NamedTuple):
    """Frames of a stream."""

    frames: NDArray[Any]
    """(frames, ...)"""
    number: NDArray[np.int64]
    time_s: NDArray[np.float64]


def holds_streams(path: Path) -> bool:
    """Return whether a path is a cube with its timing, or a folder with such cubes."""
    return bool(_cubes(path))


def read_streams(path: Path, named: Mapping[str, str]) -> dict[str, Any]:
    """Read slopes, and commands where these are named, with numbers and times of the frames.

    Each row of slopes gets the command that was sent the usual time after it; rows without one are left out.

    Parameters
    ----------
    path : path
        A cube, or a folder with those of a stream, or with a folder for each stream.
    named : mapping
        Streams of slopes and commands, or cubes; files of other arrays by quantity.

    Raises
    ------
    InputError
        When a file is damaged, or it is not known which stream holds the slopes.
    """
    streams: dict[str, list[Path]] = {}
    for cube in _cubes(path):
        streams.setdefault(_stream_of(cube), []).append(cube)
    others = [name for name in streams if name not in named.values()]
    name = named.get("slopes", others[0] if len(others) == 1 else "")
    if not name:
        raise InputError(
            f"{path}: has {len(streams)} streams; name that of the slopes with --slopes: {listed(streams)}"
        )
    slopes = _read(path, streams, name)
    sources = {"slopes": name, "frame": "cnt0", "time_s": "its times of acquisition"}
    values: dict[str, Any] = {"origin": "streams of milk's logger", "sources": sources}
    rows = np.arange(len(slopes.frames))
    if "commands" in named:
        commands = _read(path, streams, named["commands"])
        rows, sent = _matched(slopes.time_s, commands.time_s)
        if len(sent) < 2:
            raise InputError(
                f"{path}: expected commands at the times of slopes, got {len(sent)}; name others"
            )
        sent_rows = commands.frames[sent]
        values["commands"], sources["commands"] = sent_rows.reshape(len(sent), -1), named["commands"]
    number = slopes.number[rows]
    values |= {"slopes": slopes.frames[rows], "frame": number - number[0], "time_s": slopes.time_s[rows]}
    arrays = {name: text for name, text in named.items() if name not in ("slopes", "commands")}
    return values | {name: read_array(text) for name, text in arrays.items()} | {"sources": sources | arrays}


def _cubes(path: Path) -> list[Path]:
    """Return the cubes that have their timing beside them, sorted by name."""
    files = [path] if path.is_file() else [*path.glob("*.fits*"), *path.glob("*/*.fits*")]
    return sorted(file for file in files if _ENDING.search(file.name) and _is_timing(_timing_of(file)))


def _timing_of(cube: Path) -> Path:
    return cube.with_name(_ENDING.sub(".txt", cube.name))


def _stream_of(cube: Path) -> str:
    return _STAMP.sub("", _ENDING.sub("", cube.name))


def _is_timing(file: Path) -> bool:
    """Return whether the first line of numbers has the columns of the timing of frames."""
    try:
        check_regular(file)
        with file.open("rb") as stream:
            lines = [line for line in stream.read(1 << 12).splitlines() if not line.startswith(b"#")]
        return bool(lines) and len(lines[0].split()) == _COLUMNS
    except (OSError, InputError):
        return False


def _read(path: Path, streams: Mapping[str, list[Path]], name: str) -> Stream:
    """Return a stream of a folder, or that of another cube or folder."""
    folder = path if path.is_dir() else path.parent
    places = [place for place in (Path(name), folder / name, folder.parent / name) if place.exists()]
    cubes = streams.get(name) or (_cubes(places[0]) if places else [])
    if not cubes:
        raise InputError(
            f"{name}: expected a stream with its timing; the streams of {path} are: {listed(streams)}"
        )
    parts, total = [], 0
    for cube in cubes:
        frames, timing = read_array(cube), read_array(_timing_of(cube))
        if timing.shape != (len(frames), _COLUMNS):
            raise InputError(
                f"{_timing_of(cube)}: expected {len(frames)} lines of {_COLUMNS} numbers, as the cube has "
                f"frames, got shape {timing.shape}"
            )
        total += frames.nbytes
        check_bytes(cube, total, memory_bytes() // 4, "streams")
        rising = bool((np.diff(timing[:, _ACQUIRED]) > 0).all())
        time_s = timing[:, _ACQUIRED if rising else _LOGGED].astype(np.float64)
        parts.append(Stream(frames, timing[:, _COUNTER].astype(np.int64), time_s))
    if len({part.frames.shape[1:] for part in parts}) > 1:
        raise InputError(f"{name}: expected cubes of frames of one size, got several")
    parts.sort(key=lambda part: float(part.time_s[0]))
    frames, number, time_s = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Stream(frames, number, time_s)


def _matched(
    time_s: NDArray[np.float64], sent_s: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows of slopes, and of the commands sent the usual time after them.

    That time is known up to whole frames, which the report finds; half a frame of jitter is left to each.
    """
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    following = np.minimum(np.searchsorted(sent_s, time_s), len(sent_s) - 1)
    wanted = time_s + np.median(sent_s[following] - time_s)
    after = np.clip(np.searchsorted(sent_s, wanted), 1, max(len(sent_s) - 1, 1))
    nearest = after - (
        wanted - sent_s[after - 1] < np.abs(sent_s[np.minimum(after, len(sent_s) - 1)] - wanted)
    )
    nearest = np.minimum(nearest, len(sent_s) - 1)
    rows = np.flatnonzero(np.abs(sent_s[nearest] - wanted) < period_s / 2)
    return rows, nearest[rows]


_MANIFEST = "session.json"
_SLOPES, _COMMANDS = "signal", "wfc"
_FILES = "frames", "frame_ids", "timestamps"


def holds_session(path: Path) -> bool:
    """Return whether a folder is a telemetry session of pyRTC."""
    return (path / _MANIFEST).is_file()


def read_session(path: Path) -> dict[str, Any]:
    """Read slopes, commands, numbers and times of the frames that both streams have.

    A command has the number of the frame from whose slopes it was computed.

    Raises
    ------
    InputError
        When a file is missing or damaged, or the streams have no frames in common.
    """
    try:
        records = parse_json((path / _MANIFEST).read_text(encoding="utf-8"))["streams"]
        streams = {record["name"]: record for record in records}
    except (OSError, ValueError, TypeError, KeyError):
        raise InputError(
            f"{path}: expected a session of pyRTC's telemetry, got a damaged {_MANIFEST}"
        ) from None
    for name in (_SLOPES, _COMMANDS):
        if name not in streams:
            raise InputError(
                f"{path}: expected the stream {name}, found {', '.join(sorted(streams)) or 'none'}"
            )
    slopes, slopes_of, times = (_array(path, streams[_SLOPES], kind) for kind in _FILES)
    commands, commands_of, _ = (_array(path, streams[_COMMANDS], kind) for kind in _FILES)
    for values, numbers in ((slopes, slopes_of), (commands, commands_of)):
        if values.ndim < 2 or len(values) != len(numbers) or len(slopes) != len(times):
            raise InputError(f"{path}: expected a number and a time of every frame, got {values.shape}")
    frame, first, second = np.intersect1d(slopes_of, commands_of, return_indices=True)
    if len(frame) < 2:
        raise InputError(f"{path}: expected frames that signal and wfc have in common, got {len(frame)}")
    return {
        "slopes": slopes[first],
        "commands": commands[second].reshape(len(frame), -1),
        "frame": (frame - frame[0]).astype(np.int64),
        "time_s": times[first],
        "slope_unit": "px",
    }


def _array(path: Path, record: object, kind: str) -> NDArray[Any]:
    name = record.get(f"{kind}_file") if isinstance(record, dict) else None
    if not isinstance(name, str):
        raise InputError(f"{path}: {_MANIFEST} names no {kind}_file; record it with pyRTC 2.1 or later")
    file = (path / name).resolve()
    if not file.is_relative_to(path.resolve()):
        raise InputError(f"{path}: expected files in this folder, got {name}")
    try:
        check_regular(file)
        return np.asarray(np.load(file, mmap_mode="r", allow_pickle=False))  # no more than the file holds
    except InputError:
        raise
    except (OSError, ValueError, EOFError):
        raise InputError(f"{file}: expected an array (.npy), got something else") from None
