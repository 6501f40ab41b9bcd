"""Which axis of a cube counts the frames."""

from pathlib import Path

import numpy as np
import scipy.io
from tests.io.frame_files import assert_frames

FRAMES_FIRST = [(50, 220, 220), (300, 220, 220), (100, 240, 200), (60, 6, 8), (4, 4, 4), (20, 48, 64)]
FRAMES_ELSEWHERE = [((220, 220, 50), 2), ((64, 48, 1), 2), ((220, 50, 220), 1)]
AMBIGUOUS = [((220, 220, 150), 2), ((200, 220, 50), 2), ((220, 150, 220), 1)]


def stored(folder: Path, shape: tuple[int, ...]) -> tuple[Path, np.ndarray]:
    cube = np.random.default_rng(1).integers(0, 250, shape, np.uint8)
    np.save(folder / "a.npy", cube)
    return folder / "a.npy", cube


def test_time_axis_is_recognised_or_stated(tmp_path: Path) -> None:
    for shape, axis in (*((shape, 0) for shape in FRAMES_FIRST), *FRAMES_ELSEWHERE):
        path, cube = stored(tmp_path, shape)
        note = assert_frames(path, np.moveaxis(cube, axis, 0))
        assert (f"taken for {shape[axis]} frames" in note) == bool(note) == (axis > 0)
    for shape, axis in AMBIGUOUS:
        path, cube = stored(tmp_path, shape)
        for chosen in (0, axis):
            assert not assert_frames(path, np.moveaxis(cube, chosen, 0), time_axis=chosen)


def test_matlab_cubes_with_frames_first(tmp_path: Path) -> None:
    _, cube = stored(tmp_path, (5, 40, 40))
    scipy.io.savemat(tmp_path / "a.mat", {"frames": cube})
    assert_frames(tmp_path / "a.mat", cube)


def test_axes_of_length_one(tmp_path: Path) -> None:
    for shape in ((1, 1, 6, 8), (1, 5, 6, 8), (5, 1, 6, 8), (5, 6, 8, 1), (1, 5, 1, 6, 8)):
        path, cube = stored(tmp_path, shape)
        assert_frames(path, cube.reshape(-1, 6, 8))
