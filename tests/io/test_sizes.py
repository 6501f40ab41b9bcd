"""Sizes that files state are limited: refused in one line before the memory is used."""

import gzip
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from tests import refusals
from tests.io.frame_files import fits, h5py, tifffile, zarr
from tests.io.slope_files import result, write
from tests.patience import mostly_slow

from faintspot.io import file_format, open_frames, read_array, read_slopes
from faintspot.io.fits_units import units_of
from faintspot.io.slopes import read_reference
from faintspot.io.zarr_store import check_inflated
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.spots.psf import PSF

MIB = 1 << 20

numcodecs: Any = pytest.importorskip("numcodecs")


@pytest.fixture(autouse=True)
def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of 2 MiB, so that files that exceed them are made quickly."""
    for module in ("frames", "stored_array", "zarr_store", "fits_units"):
        monkeypatch.setattr(f"faintspot.io.{module}.MOST_WHOLE_BYTES", 2 * MIB)
    monkeypatch.setattr("faintspot.base.files.MOST_BYTES", 2 * MIB)
    monkeypatch.setattr(file_format, "memory_bytes", lambda: 4 * MIB)


@contextmanager
def refused(*words: str) -> Iterator[None]:
    """Expect a refusal before much memory is used."""
    tracemalloc.start()
    try:
        with refusals.refused(*words):
            yield
        assert tracemalloc.get_traced_memory()[1] < 20 * MIB
    finally:
        tracemalloc.stop()


def test_large_array_in_npz(tmp_path: Path) -> None:
    large: Any = np.zeros((16, MIB), np.uint8)
    np.savez_compressed(tmp_path / "a.npz", samples=large, frames=large, x=large)
    for name, read in (("", PSF.load), (":frames", read_array), ("", read_slopes), ("", read_reference)):
        with refused("a.npz", "2 MiB" if name else ""):
            read(f"{tmp_path / 'a.npz'}{name}")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["npz", "fits.gz", "fits", "zarr"])
def test_slopes_beyond_the_memory(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"slopes.{ending}"
    write(path, result(100, 1000))
    with refused("MiB of memory, expected slopes of at most 2 MiB"):
        read_slopes(path)


def test_dark_of_many_frames_is_read_in_parts(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", dark=np.full((150, 256, 256), 7, np.uint8))
    (tmp_path / "a.toml").write_text('[calibration]\ndark = "a.npz:dark"\n')
    assert np.array_equal(Calibration.load(tmp_path / "a.toml").dark, np.full((256, 256), 7.0))


def test_chunks_that_are_too_large_are_refused(tmp_path: Path) -> None:
    shape = (1 << 40, 64, 64)
    zarr.create_array(str(tmp_path / "a.zarr"), shape=shape, dtype="f4", chunks=shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (100, 1000, 1000), "f8", chunks=(100, 1000, 1000))
    for name in ("a.zarr", "a.h5"):
        with refused(name, "a chunk of at most 2 MiB"):
            open_frames([tmp_path / name])


@pytest.mark.parametrize("filters", ["deflate", "deflate, deflate", "shuffle, deflate", "zstd"])
def test_hdf5_chunks_that_inflate_to_more(tmp_path: Path, filters: str) -> None:
    """A chunk of 20 kB that is inflated to 24 MiB; also one that says that it was not shuffled."""
    content = bytes(24 * MIB)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((1, 100, 100))
        for name in filters.split(", "):
            if name == "shuffle":
                layout.set_shuffle()
            elif name == "zstd":
                layout.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)
                content = numcodecs.Zstd().encode(content)
            else:
                layout.set_deflate(1)
                content = zlib.compress(content, 1)
        space, kind = h5py.h5s.create_simple((2, 100, 100)), h5py.h5t.NATIVE_UINT16
        stored = h5py.h5d.create(file.id, b"frames", kind, space, layout)
        if filters != "zstd":  # HDF5 itself has no such filter
            stored.write_direct_chunk((0, 0, 0), zlib.compress(bytes(20000)))
        stored.write_direct_chunk((1, 0, 0), content, int(filters.startswith("shuffle")))
    reason = "compressed 2 times" if filters == "deflate, deflate" else "inflates to more"
    with refused("a.h5", reason), open_frames([tmp_path / "a.h5"]) as frames:
        assert filters == "zstd" or not frames.block(0, 1).any()
        frames.block(1, 2)


CODECS = [
    *((3, codec) for codec in ("", "gzip", "zstd", "blosc")),  # formats of others are not fixed
    *((2, codec) for codec in ("", "zlib", "gzip", "zstd", "blosc", "lz4", "bz2", "lzma")),
]


@pytest.mark.parametrize(("zarr_format", "codec"), mostly_slow(6, CODECS))
def test_zarr_chunks_that_inflate_to_more(tmp_path: Path, zarr_format: int, codec: str) -> None:
    """The file of a chunk is too large, or inflates to 24 MiB; that of gzip after a small first part."""
    numcodec = numcodecs.get_codec({"id": codec}) if codec else None
    path, options = tmp_path / "a.zarr", {"chunks": (1, 1000, 1000), "zarr_format": zarr_format}
    options["compressors"] = numcodec
    if zarr_format == 3 and codec:
        options["compressors"] = getattr(zarr.codecs, f"{codec.title()}Codec")()
    zarr.create_array(str(path), data=np.ones((2, 1000, 1000), np.uint16), **options)
    content = bytes(24 * MIB) if numcodec is None else bytes(numcodec.encode(bytes(24 * MIB)))
    if codec == "gzip":
        content = gzip.compress(bytes(100)) + content
    (path / ("1.0.0" if zarr_format == 2 else "c/1/0/0")).write_bytes(content)
    with (
        refused("a.zarr", "inflates to more" if codec else "a chunk of at most"),
        open_frames([path]) as frames,
    ):
        assert frames.block(0, 1).all()
        frames.block(1, 2)


def test_zstd_that_states_no_size() -> None:
    """Its blocks state how much they inflate to at most."""
    frame = b"\x28\xb5\x2f\xfd\x00\x58"
    block = (1 | 1 << 1 | (1 << 20) << 3).to_bytes(3, "little") + b"\0"  # the last one: a byte, 2^20 times
    check_inflated("a", frame + block, "zstd")
    more = ((1 << 1 | (1 << 20) << 3).to_bytes(3, "little") + b"\0") * 8
    with refused("inflates to more"):
        check_inflated("a", frame + more + block, "zstd")


def test_tiff_strips_and_tiles(tmp_path: Path) -> None:
    strips = iter([zlib.compress(bytes(24 * MIB))])
    tifffile.imwrite(
        tmp_path / "strips.tif", strips, shape=(64, 64), dtype=np.uint16, compression="zlib", rowsperstrip=64
    )
    tifffile.imwrite(tmp_path / "tiles.tif", np.ones((64, 64), np.uint16), compression="zlib", tile=(64, 64))
    with tifffile.TiffFile(tmp_path / "tiles.tif", mode="r+b") as file:
        for tag in (322, 323):
            file.pages[0].tags[tag].overwrite(1 << 14)
    for name, words in (("strips.tif", "inflates to more"), ("tiles.tif", "a chunk of at most 2 MiB")):
        with refused(name, words):
            read_array(tmp_path / name)


@pytest.mark.parametrize("is_damaged", [False, True])
@pytest.mark.parametrize("is_aot", [False, True])
def test_fits_tiles_that_inflate_too_far_are_refused(tmp_path: Path, is_damaged: bool, is_aot: bool) -> None:
    """A tile of 16 MiB, which inflates to more than the image of 64 x 64 px where the header is changed."""
    image = fits.CompImageHDU(
        np.zeros((4096, 4096), np.uint8), compression_type="GZIP_1", tile_shape=(4096, 4096)
    )
    primary = fits.PrimaryHDU()
    if is_aot:
        pytest.importorskip("aotpy")
        primary.header["AOT-VERS"] = "1.0.0"
    fits.HDUList([primary, image]).writeto(tmp_path / "a.fits")
    content = (tmp_path / "a.fits").read_bytes()
    if is_damaged:
        content = content.replace(b"=                 4096 ", b"=                   64 ")
    (tmp_path / "a.fits").write_bytes(content)
    with refused("a.fits", "inflates to more" if is_damaged else "a chunk of at most 2 MiB"):
        read_array(tmp_path / "a.fits")
    (unit,) = (unit for unit in units_of(tmp_path / "a.fits") if unit.compressed)
    assert unit.value_bytes == (64 * 64 if is_damaged else 16 * MIB)


def test_frames_of_too_many_chunks_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = np.arange(6 * 8 * 8, dtype=np.uint16).reshape(6, 8, 8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", data=frames, chunks=(1, 2, 2))
    zarr.create_array(str(tmp_path / "a.zarr"), data=frames, chunks=(1, 2, 2))
    for name in ("a.h5", "a.zarr"):
        monkeypatch.setattr("faintspot.io.stored_array.MOST_CHUNKS", 40)
        with open_frames([tmp_path / name]) as source:
            np.testing.assert_array_equal(source.block(0, 6), frames)
        monkeypatch.setattr("faintspot.io.stored_array.MOST_CHUNKS", 15)
        with refused(name, "16 chunks in a frame"):
            open_frames([tmp_path / name])


def test_large_matlab_variable(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"frames": np.zeros((16, 1024, 1024), np.uint8)})
    with refused("a.mat", "of memory, expected an array of at most 2 MiB"):
        open_frames([tmp_path / "a.mat"])


def test_more_pixels_than_a_frame_may_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one byte each they need less memory than is allowed; arrays made from them need more."""
    monkeypatch.setattr("faintspot.io.frames.MOST_WHOLE_BYTES", 1 << 30)
    np.lib.format.open_memmap(tmp_path / "map.npy", "w+", np.uint8, (1 << 14, 1 << 15))  # no disk is used
    with refused("16384 x 32768"):
        read_array(tmp_path / "map.npy")
