"""Cubes of milk's logger with their timing, and commands at the times of slopes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io import loop_layouts
from tests.io.loop_layouts import RATE_HZ, START_S, random_loop
from tests.refusals import refused

from faintspot.io.loop_streams import holds_session, holds_streams, read_session, read_streams

fits = pytest.importorskip("astropy.io.fits")
LOOP = random_loop(60)


@pytest.mark.parametrize("latency_s", [0.0, 0.0007, 0.0038, 0.009])
def test_slopes_and_commands(tmp_path: Path, latency_s: float) -> None:
    """Commands are those of the same row, up to whole frames of latency, which the report finds."""
    folder = loop_layouts.milk(tmp_path, LOOP, 3, latency_s)
    assert holds_streams(folder)
    with refused("has 2 streams", "--slopes: dm, wfs"):
        read_streams(folder, {})
    values = read_streams(folder, {"slopes": "wfs", "commands": "dm"})
    late = int(latency_s * RATE_HZ)
    rows = np.searchsorted(START_S + np.arange(60) / RATE_HZ, values["time_s"] - 1e-4)
    assert len(rows) >= 59 - late
    np.testing.assert_array_equal(values["slopes"].reshape(len(rows), -1), LOOP.slopes[rows])
    np.testing.assert_array_equal(values["commands"][late:], LOOP.commands[rows[late:] - late])
    np.testing.assert_array_equal(values["frame"], rows - rows[0])


def test_lost_frames_and_jitter(tmp_path: Path) -> None:
    """Of frames that either stream lost, nothing is kept; jitter of a third of a frame moves no command."""
    folder = loop_layouts.milk(tmp_path, LOOP, 1, 0.002)
    rng = np.random.default_rng(8)
    lost = {"wfs": [5, 6, 30], "dm": [10, 31, 32]}
    for stream, rows in lost.items():
        (text,) = (folder / stream).glob("*.txt")
        timing = np.delete(np.loadtxt(text), rows, axis=0)
        timing[:, 4] += rng.uniform(-1, 1, len(timing)) * (stream == "dm") / RATE_HZ / 3
        np.savetxt(text, timing, fmt="%.7f")
        cube = text.with_suffix(".fits")
        fits.writeto(cube, np.delete(fits.getdata(cube), rows, axis=0), overwrite=True)
    values = read_streams(folder, {"slopes": "wfs", "commands": "dm"})
    kept = np.setdiff1d(np.arange(60), [5, 6, 30, 10, 31, 32])
    np.testing.assert_array_equal(values["frame"], kept)
    np.testing.assert_array_equal(values["slopes"].reshape(len(kept), -1), LOOP.slopes[kept])
    np.testing.assert_array_equal(values["commands"], LOOP.commands[kept])


def test_single_cube_is_read_with_its_folder(tmp_path: Path) -> None:
    loop_layouts.milk(tmp_path, LOOP, 1)
    (cube,) = (tmp_path / "wfs").glob("*.fits")
    np.save(tmp_path / "im.npy", LOOP.matrix)
    values = read_streams(cube, {"interaction_matrix": f"{tmp_path / 'im.npy'}"})
    np.testing.assert_array_equal(values["slopes"].reshape(len(values["slopes"]), -1), LOOP.slopes)
    np.testing.assert_array_equal(values["interaction_matrix"], LOOP.matrix)
    assert "commands" not in values
    values = read_streams(cube, {"commands": "dm"})
    np.testing.assert_array_equal(values["commands"], LOOP.commands)
    with refused("absent", "the streams", "wfs"):
        read_streams(cube, {"commands": "absent"})


def test_cubes_that_are_damaged(tmp_path: Path) -> None:
    folder = loop_layouts.milk(tmp_path, LOOP, 1)
    (text,) = (folder / "wfs").glob("*.txt")
    lines = text.read_text().splitlines()
    text.write_text("\n".join(lines[:-3]))
    with refused("expected 60 lines of 7 numbers", ".txt"):
        read_streams(folder, {"slopes": "wfs"})
    text.write_text("\n".join([*lines[:-1], "60 x"]))
    with refused("rows of numbers", ".txt"):
        read_streams(folder, {"slopes": "wfs"})
    text.write_text("1 2 3\n")
    assert not holds_streams(folder / "wfs")
    text.unlink()
    assert not holds_streams(text.with_suffix(".fits"))


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame_ids_file": None}, "frame_ids_file"),
        ({"frames_file": "../outside.npy"}, "../outside.npy"),
        ({"frames_file": "absent.npy"}, "absent.npy"),
        ({"name": "wfs"}, "stream signal"),
        ({"signal": [0, 1, 2], "wfc": [5, 6, 7]}, "got 0"),
    ],
)
def test_damaged_sessions_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    assert not holds_session(tmp_path)
    session(tmp_path, **change)
    assert holds_session(tmp_path)
    with refused(words):
        read_session(tmp_path)
    (tmp_path / "session.json").write_text("[]")
    with refused("session.json"):
        read_session(tmp_path)
