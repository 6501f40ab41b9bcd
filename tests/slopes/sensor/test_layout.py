from dataclasses import FrozenInstanceError
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.refusals import assert_each_refused, refused

import faintspot as fs


class TestGrid:
    @pytest.mark.parametrize(
        ("shape", "outer", "inner", "count"),
        [
            ((7, 7), 3.5, 0.5, 36),
            ((7, 7), 3.7, 1.2, 40),
            ((7, 7), None, None, 49),
            ((7, 7), 0.0, None, 1),
            ((2, 3), None, None, 6),
            ((40, 40), 20.0, 0.0, 1264),
        ],
    )
    def test_number_of_illuminated_subapertures(self, shape: Any, outer: Any, inner: Any, count: int) -> None:
        layout = fs.Layout.grid(shape, pixels=4, outer_radius=outer, inner_radius=inner)
        distance = [np.hypot(i - (shape[0] - 1) / 2, j - (shape[1] - 1) / 2) for i, j in np.ndindex(shape)]
        illuminated = [d for d in distance if (inner or 0) <= d <= (np.inf if outer is None else outer)]
        assert len(layout) == len(illuminated)
        assert len(layout) == count

    def test_grid_places_windows_row_by_row(self) -> None:
        layout = fs.Layout.grid((2, 3), pixels=(4, 6), pitch=(5, 8), origin=(1, 2))
        assert layout.corners.tolist() == [[1, 2], [1, 10], [1, 18], [6, 2], [6, 10], [6, 18]]
        assert layout.cells.tolist() == [[i, j] for i in range(2) for j in range(3)]
        assert layout.centres[1].tolist() == [12.5, 2.5]
        assert layout.frame_shape == (10, 24)
        assert layout.window == (4, 6)
        assert layout.pixels == 24
        assert layout.pitch_px == 5.0
        assert np.array_equal(layout.offsets, np.zeros((6, 2)))

    def test_grid_refuses_wrong_arguments(self) -> None:
        good = partial(fs.Layout.grid, shape=(7, 7), pixels=4)
        assert_each_refused(
            good,
            pitch=[0],
            pixels=[1, 65, 4.5, (4, 4, 4)],
            outer_radius=[-1.0, np.nan],
            origin=[(-1, 0)],
            shape=[(0, 4), "square"],
        )
        for words, options in (
            ("no sub-aperture is illuminated", {"outer_radius": 1.0, "inner_radius": 2.0}),
            ("overlap", {"pitch": 3}),
            ("leaves the frame of 10 x 28", {"frame_shape": (10, 28)}),
        ):
            with refused(words):
                good(**options)


class TestLayout:
    def test_is_immutable_and_private(self) -> None:
        corners = np.array([[0, 0], [0, 8]])
        layout = fs.Layout((8, 16), (8, 8), corners)
        corners[0, 0] = 5
        assert layout.corners[0, 0] == 0
        for array in (layout.corners, layout.centres, layout.cells):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 1
        with pytest.raises(FrozenInstanceError):
            layout.window = (4, 4)  # type: ignore[misc]

    def test_layouts_are_equal_if_all_their_parts_are(self) -> None:
        grid = fs.Layout.grid((3, 3), pixels=8)
        assert grid == fs.Layout.grid((3, 3), pixels=8)
        assert grid != fs.Layout.grid((3, 3), pixels=8, origin=(0, 1))
        assert grid != fs.Layout(grid.frame_shape, grid.window, grid.corners, grid.centres + 0.1)
        assert grid != "grid"

    def test_centres_off_the_windows(self) -> None:
        layout = fs.Layout((8, 8), 4, [[0, 0], [4, 4]], [[2.0, 1.0], [5.5, 5.5]])  # type: ignore[arg-type]
        assert layout.window == (4, 4)
        assert layout.offsets.tolist() == [[0.5, -0.5], [0.0, 0.0]]

    def test_layout_refuses_wrong_arguments(self) -> None:
        beyond = [[[3.5, 3.5], [1e39, 3.5]], [[3.5, -21.0], [11.5, 3.5]]]
        assert_each_refused(
            partial(fs.Layout, frame_shape=(8, 16), window=(8, 8), corners=np.array([[0, 0], [0, 8]])),
            corners=[np.empty((0, 2)), [0, 0], [[1, True]], [[0.5, 0]], [[np.nan, 0]], [[0, 0], [0]]],
            centres=[[[1.0, 1.0]], [[1.0, np.inf], [1, 1]], *beyond],
            cells=[[[0, 0]], [[0.5, 0], [0, 1]]],
            window=[(1, 2)],
            frame_shape=[(8, 16, 3)],
        )
        for words, corners in (
            ("sub-aperture 1 (rows 0 to 7, columns 9 to 16) leaves the frame", [[0, 0], [0, 9]]),
            ("sub-aperture 0", [[-1, 0], [0, 8]]),
            ("sub-apertures 0 and 1 overlap", [[0, 0], [0, 7]]),
            ("sub-apertures 0 and 1 overlap", [[0, 0], [0, 0]]),
        ):
            with refused("layout", words):
                fs.Layout((8, 16), (8, 8), np.array(corners))

    @given(st.integers(0, 2**32 - 1))
    def test_overlap_is_what_two_windows_share(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        ny, nx = (int(n) for n in rng.integers(4, 9, 2))
        corners = rng.integers(0, 24, (3, 2))
        covered = np.zeros((40, 40), int)
        for row, column in corners:
            covered[row : row + ny, column : column + nx] += 1
        if covered.max() > 1:
            with refused("overlap"):
                fs.Layout((40, 40), (ny, nx), corners)
        else:
            assert len(fs.Layout((40, 40), (ny, nx), corners)) == 3


class TestSelection:
    def test_a_mask_numbers_or_a_slice(self) -> None:
        layout = fs.Layout.grid((3, 4), pixels=8, outer_radius=1.9)
        mask = np.arange(len(layout)) % 3 == 0
        chosen = layout[mask]
        assert len(chosen) == np.count_nonzero(mask)
        for name in ("corners", "centres", "cells"):
            assert np.array_equal(getattr(chosen, name), getattr(layout, name)[mask])
        assert (chosen.frame_shape, chosen.pitch_px) == (layout.frame_shape, layout.pitch_px)
        assert layout[np.flatnonzero(mask)] == layout[::3] == chosen
        assert np.array_equal(layout[[5, -1]].corners, layout.corners[[5, -1]])
        assert layout[layout.centres[:, 0] > 0] == layout

    @pytest.mark.parametrize(
        ("words", "chosen"),
        [
            ("mask of 4, got 3", np.ones(3, bool)),
            ("got none", np.zeros(4, bool)),
            ("got none", slice(4, 9)),
            ("= 4: expected a number from -4 to 3", [0, 4]),
            ("twice", [0, -4]),
            ("whole number", [0.5]),
            ("a mask, a slice or a list", 1),
            ("a mask, a slice or a list", [[0, 1]]),
        ],
    )
    def test_what_cannot_be_chosen(self, words: str, chosen: Any) -> None:
        with refused("layout[", words):
            fs.Layout.grid((2, 2), pixels=4)[chosen]


class TestImages:
    def test_windows_of_a_frame(self) -> None:
        layout = fs.Layout((9, 13), (4, 5), np.array([[1, 2], [5, 8]]))
        frame = np.arange(9 * 13).reshape(9, 13)
        assert np.array_equal(layout.images(frame), [frame[1:5, 2:7], frame[5:9, 8:13]])
        cube = np.stack([frame, -frame])
        assert layout.images(cube).shape == (2, 2, 4, 5)
        assert np.array_equal(layout.images(cube)[1], -layout.images(frame))
        assert layout.images(frame).dtype == frame.dtype

    def test_frames_of_another_shape_are_refused(self) -> None:
        with refused("frame", "(8, 8)", "(8, 9)"):
            fs.Layout.grid((2, 2), pixels=4).images(np.zeros((8, 9)))


def test_repr_is_one_line() -> None:
    assert len(repr(fs.Layout.grid((40, 40), pixels=2))) < 200
