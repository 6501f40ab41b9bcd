"""Which axis of a cube counts the frames."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from faintspot.io import open_frames


def stored(folder: Path, shape: tuple[int, ...]) -> tuple[Path, np.ndarray]:
    cube = np.random.default_rng(1).integers(0, 1000, shape).astype(np.int16)
    np.save(folder / "a.npy", cube)
    return folder / "a.npy", cube


FRAMES_FIRST = [(50, 220, 220), (300, 220, 220), (100, 240, 200), (60, 6, 8), (4, 4, 4), (20, 48, 64)]
FRAMES_ELSEWHERE = [((220, 220, 50), 2), ((64, 48, 1), 2), ((220, 50, 220), 1)]


@pytest.mark.parametrize(("shape", "axis"), [*((shape, 0) for shape in FRAMES_FIRST), *FRAMES_ELSEWHERE])
def test_time_axis_is_recognised(tmp_path: Path, shape: tuple[int, ...], axis: int) -> None:
    path, cube = stored(tmp_path, shape)
    with open_frames([path]) as source:
        frames = np.moveaxis(cube, axis, 0)
        assert (source.n_frames, *source.shape) == frames.shape
        np.testing.assert_array_equal(source.block(0, len(frames)), frames)
        np.testing.assert_array_equal(source.block(len(frames) - 1, len(frames)), frames[-1:])
        assert (f"taken for {len(frames)} frames" in source.note) == bool(source.note) == (axis > 0)


@pytest.mark.parametrize(("shape", "axis"), [((220, 220, 150), 2), ((200, 220, 50), 2), ((220, 150, 220), 1)])
def test_ambiguous_cubes_with_a_stated_time_axis(tmp_path: Path, shape: tuple[int, ...], axis: int) -> None:
    path, cube = stored(tmp_path, shape)
    for chosen in (0, axis):
        with open_frames([path], time_axis=chosen) as source:
            frames = np.moveaxis(cube, chosen, 0)
            np.testing.assert_array_equal(source.block(1, 4), frames[1:4])
            assert not source.note


def test_matlab_cubes_with_frames_first(tmp_path: Path) -> None:
    _, cube = stored(tmp_path, (5, 40, 40))
    scipy.io.savemat(tmp_path / "a.mat", {"frames": cube})
    with open_frames([tmp_path / "a.mat"]) as source:
        assert (source.n_frames, *source.shape) == (5, 40, 40)
        np.testing.assert_array_equal(source.block(0, 5), cube)


def test_axes_of_length_one(tmp_path: Path) -> None:
    for shape in ((1, 1, 6, 8), (1, 5, 6, 8), (5, 1, 6, 8), (5, 6, 8, 1), (1, 5, 1, 6, 8)):
        path, cube = stored(tmp_path, shape)
        with open_frames([path]) as source:
            frames = cube.reshape(-1, 6, 8)
            np.testing.assert_array_equal(source.block(0, len(frames)), frames)
