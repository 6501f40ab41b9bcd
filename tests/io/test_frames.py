"""Frames of several files as one sequence, whole arrays, and refused files of no particular format."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.frame_files import cube, save
from tests.refusals import refused

from faintspot.io import open_frames, read_array


class TestSequence:
    @given(st.data())
    def test_concatenation_of_files(self, tmp_path_factory: pytest.TempPathFactory, data: Any) -> None:
        folder = tmp_path_factory.mktemp("parts")
        counts = data.draw(st.lists(st.integers(1, 4), min_size=1, max_size=4))
        frames = cube(sum(counts))
        endings = st.lists(
            st.sampled_from(["npy", "npz", "fits.gz"]), min_size=len(counts), max_size=len(counts)
        )
        ends = np.cumsum(counts)
        paths = [
            save(folder / f"{i}.{ending}", frames[end - count : end])
            for i, (ending, count, end) in enumerate(zip(data.draw(endings), counts, ends, strict=True))
        ]
        start = data.draw(st.integers(0, len(frames) - 1))
        stop = data.draw(st.integers(start + 1, len(frames)))
        with open_frames(paths) as source:
            assert source.n_frames == len(frames)
            np.testing.assert_array_equal(source.block(start, stop), frames[start:stop])

    def test_different_types_are_promoted(self, tmp_path: Path) -> None:
        paths = [save(tmp_path / "a.npy", cube()), save(tmp_path / "b.npy", cube(dtype="float32"))]
        with open_frames(paths) as source:
            assert source.dtype == np.float32
            assert source.block(0, 1).dtype == np.float32
            assert source.description.endswith("a.npy and 1 more")

    def test_other_size_and_range(self, tmp_path: Path) -> None:
        a, b = save(tmp_path / "a.npy", cube()), save(tmp_path / "b.npy", cube(2, 6, 9))
        with refused("b.npy", "6 x 9", "a.npy", "6 x 8"):
            open_frames([a, b])
        with open_frames([a]) as source:
            for start, stop in [(-1, 2), (3, 3), (5, 12)]:
                with refused("expected 0 to 11"):
                    source.block(start, stop)
        with refused("at least one file"):
            open_frames([])


class TestReadArray:
    def test_any_dimensions_and_bool(self, tmp_path: Path) -> None:
        mask = cube()[0] > 0
        np.savez(tmp_path / "a.npz", mask=mask, line=np.arange(5.0))
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:mask"), mask)
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:line"), np.arange(5.0))
