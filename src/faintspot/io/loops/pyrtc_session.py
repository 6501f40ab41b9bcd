"""Telemetry sessions of pyRTC: streams "signal" and "wfc" as NumPy files in a folder with session.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular
from faintspot.base.text_files import parse_json

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
        listed = parse_json((path / _MANIFEST).read_text(encoding="utf-8"))["streams"]
        streams = {record["name"]: record for record in listed}
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
        "slopes": slopes[first].reshape(len(frame), -1),
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
