"""Sessions of pyRTC's telemetry, as its files are laid out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintspot.base.errors import InputError
from faintspot.io.loops.pyrtc_session import holds_session, read_session

SLOPES = np.arange(60, dtype=np.float32).reshape(10, 6)
COMMANDS = np.arange(40, dtype=np.float32).reshape(10, 4, 1)


def session(folder: Path, signal: Any = range(10), wfc: Any = range(10), **other: Any) -> Path:
    """Write a session whose streams have these numbers of frames."""
    streams = []
    for name, frames, numbers in (("signal", SLOPES, signal), ("wfc", COMMANDS, wfc)):
        (folder / name).mkdir()
        kept = np.array(numbers, np.uint64)
        arrays: dict[str, Any] = {
            "frames": frames[kept],
            "frame_ids": 100 + kept,
            "timestamps": 5.0 + 0.004 * kept,
        }
        for kind, array in arrays.items():
            np.save(folder / name / f"{kind}.npy", array)
        streams.append({"name": name, **{f"{kind}_file": f"{name}/{kind}.npy" for kind in arrays}, **other})
    (folder / "session.json").write_text(json.dumps({"streams": streams}))
    return folder


def test_frames_are_matched_by_their_numbers(tmp_path: Path) -> None:
    """Of slopes that came before the first command, and of lost frames, nothing is kept."""
    values = read_session(session(tmp_path, [0, 1, 2, 4, 5, 6, 8], [2, 3, 4, 5, 6, 7, 8]))
    kept = [2, 4, 5, 6, 8]
    np.testing.assert_array_equal(values["slopes"], SLOPES[kept])
    np.testing.assert_array_equal(values["commands"], COMMANDS[kept, :, 0])
    np.testing.assert_array_equal(values["frame"], [0, 2, 3, 4, 6])
    np.testing.assert_allclose(values["time_s"], 5.0 + 0.004 * np.array(kept))


def test_which_folders_are_sessions(tmp_path: Path) -> None:
    assert not holds_session(tmp_path)
    assert not holds_session(tmp_path / "absent.npz")
    assert holds_session(session(tmp_path))


def test_no_frames_in_common(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="frames that signal and wfc have in common, got 0"):
        read_session(session(tmp_path, [0, 1, 2], [5, 6, 7]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame_ids_file": None}, "names no frame_ids_file"),
        ({"frames_file": "../outside.npy"}, "expected files in this folder"),
        ({"frames_file": "absent.npy"}, "expected an array"),
        ({"name": "wfs"}, "expected the stream signal, found wfs"),
    ],
)
def test_damaged_sessions(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_session(session(tmp_path, **change))


def test_damaged_manifest(tmp_path: Path) -> None:
    (tmp_path / "session.json").write_text("[]")
    with pytest.raises(InputError, match=r"damaged session\.json"):
        read_session(tmp_path)
