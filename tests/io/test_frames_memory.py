from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from tests.io.frame_files import fits, save

from faintspot.io import FrameSource, open_frames


class TestBoundedMemory:
    """A block of 10 frames of 128 x 128 int16 is 0.33 MB; the files hold 4 GB or 26 MB."""

    LIMIT_BYTES = 8_000_000

    def peak(self, source: FrameSource, blocks: list[tuple[int, int]]) -> int:
        tracemalloc.start()
        try:
            for start, stop in blocks:
                source.block(start, stop)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    def test_sparse_files_larger_than_memory_allows(self, tmp_path: Path) -> None:
        shape = (131_072, 128, 128)
        mapped = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.int16, shape)
        mapped[100_000] = 7
        del mapped
        header = fits.PrimaryHDU(np.zeros((1, 128, 128), np.int16)).header
        header["NAXIS3"] = shape[0]
        with (tmp_path / "a.fits").open("wb") as stream:
            stream.write(header.tostring().encode())
            stream.truncate(len(header.tostring()) + 2 * shape[0] * 128 * 128)
        for name, value in (("a.npy", 7), ("a.fits", 0)):
            with open_frames([tmp_path / name]) as source:
                assert (
                    self.peak(source, [(0, 10), (99_995, 100_005), (shape[0] - 10, shape[0])])
                    < self.LIMIT_BYTES
                )
                assert source.block(100_000, 100_001).max() == value

    @pytest.mark.parametrize(
        "name", ["a.fits.gz", "a.deflated.npz", "a.npz", "a.fits.fz", "v3.zarr", "pages.tif", "deflated.tif"]
    )
    def test_compressed_files(self, tmp_path: Path, name: str) -> None:
        frames = np.zeros((800, 128, 128), np.int16)
        frames[:, 5, 6] = np.arange(800)
        path = save(tmp_path / name, frames)
        with open_frames([path]) as source:
            assert self.peak(source, [(0, 10), (300, 310), (790, 800)]) < self.LIMIT_BYTES
            np.testing.assert_array_equal(source.block(300, 310), frames[300:310])
