"""Files that are larger than they look: refused before they take the memory, and nothing waits for a pipe."""

from __future__ import annotations

import gzip
import json
import os
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from tests.io.frame_files import cube, save, tifffile, zarr
from tests.io.slope_files import result, write

from faintspot.base.errors import InputError
from faintspot.base.npz import read_arrays
from faintspot.io import open_frames, read_array, read_slopes
from faintspot.io.arrays import inflation, raw
from faintspot.io.references import read_reference
from faintspot.io.stored import slopes_format
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.score import TrainedScore

h5py: Any = pytest.importorskip("h5py")
MIB = 1 << 20
PEAK = 30 * MIB


@pytest.fixture(autouse=True)
def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of a few MB, so that files which exceed them are made in no time."""
    for module in (raw, inflation):
        monkeypatch.setattr(module, "MOST_WHOLE_BYTES", 8 * MIB)
    monkeypatch.setattr("faintspot.io.frames.MOST_WHOLE_BYTES", 8 * MIB)
    monkeypatch.setattr("faintspot.io.arrays.zarr_store.MOST_WHOLE_BYTES", 8 * MIB)
    monkeypatch.setattr("faintspot.io.formats.hdf5_files.MOST_WHOLE_BYTES", 8 * MIB)
    monkeypatch.setattr(inflation, "_ALWAYS_BYTES", 1 * MIB)
    monkeypatch.setattr(inflation.check_inflated, "__defaults__", (8 * MIB,))
    monkeypatch.setattr(read_arrays, "__defaults__", (None, (), 8 * MIB))
    monkeypatch.setattr(slopes_format, "memory_bytes", lambda: 16 * MIB)


def refused(call: Callable[[], Any], *words: str) -> None:
    """An InputError in one line, before much memory is taken."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            call()
        assert tracemalloc.get_traced_memory()[1] < PEAK
    finally:
        tracemalloc.stop()
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


READERS = {
    "PSF": PSF.load,
    "score": TrainedScore.load,
    "array": read_array,
    "arrays": lambda path: read_arrays(path, "a PSF", most=8 * MIB),
    "slopes": read_slopes,
    "reference": read_reference,
}


@pytest.mark.parametrize("reader", READERS)
def test_arrays_that_unpack_to_much(tmp_path: Path, reader: str) -> None:
    path = tmp_path / "a.npz"
    names = ("samples", "tables", "x", "frames") if reader != "array" else ("frames",)
    arrays: Any = {name: np.zeros((64, MIB), np.uint8) for name in names}
    np.savez_compressed(path, **arrays)
    assert path.stat().st_size < MIB
    refused(lambda: READERS[reader](path), str(path))


def test_zip_member_that_holds_more_than_it_states(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, dark=np.zeros((64, MIB), np.uint8))
    content = path.read_bytes()
    honest = zipfile.ZipFile(path).getinfo("dark.npy").file_size
    path.write_bytes(content.replace(honest.to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    refused(lambda: read_arrays(path, "a dark", most=8 * MIB))
    refused(lambda: read_array(path))


@pytest.mark.parametrize("ending", ["npz", "fits.gz", "fits"])
def test_slopes_beyond_the_memory(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"slopes.{ending}"
    write(path, result(400, 1000))
    refused(lambda: read_slopes(path), "MiB of memory, expected slopes of at most 8 MiB")


def test_dark_of_many_frames_is_read_in_parts(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", dark=np.full((600, 256, 256), 7, np.uint8))
    path = tmp_path / "a.toml"
    path.write_text('[calibration]\ndark = "a.npz:dark"\n')
    assert np.array_equal(Calibration.load(path).dark, np.full((256, 256), 7.0))


class TestTiff:
    def test_large_page(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tif"
        strip = zlib.compress(bytes(1 << 28))
        how: Any = {
            "shape": (1 << 14, 1 << 14),
            "dtype": "u1",
            "compression": "zlib",
            "rowsperstrip": 1 << 14,
        }
        tifffile.imwrite(path, iter([strip]), **how)
        refused(lambda: open_frames([path]), "expected at most 67,108,864 pixels")

    def test_strip_that_inflates_to_more(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tif"
        bomb = zlib.compress(bytes(64 * MIB))
        tifffile.imwrite(path, iter([bomb]), shape=(64, 64), dtype="u1", compression="zlib", rowsperstrip=64)
        refused(lambda: open_frames([path]).block(0, 1), "a.tif", "of memory")


class TestZarr:
    @pytest.mark.parametrize("codec", ["zstd", "gzip", "blosc", "zlib", "bz2", "lzma"])
    def test_chunk_that_inflates_to_more(self, tmp_path: Path, codec: str) -> None:
        numcodecs = pytest.importorskip("numcodecs")

        path = tmp_path / "a.zarr"
        chosen = numcodecs.get_codec({"id": codec})
        zarr.create_array(str(path), data=cube(4), chunks=(4, 6, 8), zarr_format=2, compressors=chosen)
        with open_frames([path]) as frames:
            assert np.array_equal(frames.block(0, 4), cube(4))
        (path / "0.0.0").write_bytes(chosen.encode(np.zeros(64 * MIB, np.uint8)))
        with open_frames([path]) as frames:
            refused(lambda: frames.block(0, 4), "a.zarr", "of memory, expected")

    def test_large_chunks_and_codecs_in_a_row(self, tmp_path: Path) -> None:
        zarr.create_array(
            str(tmp_path / "a.zarr"), shape=(1 << 40, 64, 64), dtype="f4", chunks=(1 << 40, 64, 64)
        )
        refused(lambda: open_frames([tmp_path / "a.zarr"]), "a chunk of at most 8 MiB")
        codecs = [zarr.codecs.GzipCodec(), zarr.codecs.ZstdCodec()]
        zarr.create_array(str(tmp_path / "b.zarr"), data=cube(), compressors=codecs)
        refused(lambda: open_frames([tmp_path / "b.zarr"]), "compressed once")

    @pytest.mark.parametrize("place", ["c/0/0/0", "zarr.json"])
    @pytest.mark.parametrize("kind", ["pipe", "device"])
    def test_what_is_no_regular_file(self, tmp_path: Path, place: str, kind: str) -> None:
        file = save(tmp_path / "a.v3.zarr", cube()) / place
        file.unlink()
        replace(file, kind)
        refused(lambda: open_frames([tmp_path / "a.v3.zarr"]).block(0, 1), "a.v3.zarr")

    @pytest.mark.parametrize("kind", ["pipe", "device"])
    def test_chunk_of_slopes(self, tmp_path: Path, kind: str) -> None:
        write(tmp_path / "slopes.zarr", result())
        file = tmp_path / "slopes.zarr" / "x" / "c.0.0"
        file.unlink()
        replace(file, kind)
        refused(lambda: read_slopes(tmp_path / "slopes.zarr"), "slopes.zarr")


class TestHdf5:
    def test_chunk_that_inflates_to_more(self, tmp_path: Path) -> None:
        path = save(tmp_path / "a.gzip.h5", cube())
        with h5py.File(path, "r+") as file:
            item = file["detector/frames"]
            item.id.write_direct_chunk((3, 0, 0), zlib.compress(bytes(64 * MIB)))
        with open_frames([path]) as frames:
            assert np.array_equal(frames.block(0, 3), cube()[:3])
            refused(lambda: frames.block(3, 4), "a.gzip.h5", "of memory")

    def test_chunks_that_are_large(self, tmp_path: Path) -> None:
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("frames", (100, 1000, 1000), "f8", chunks=(100, 1000, 1000))
        refused(lambda: open_frames([tmp_path / "a.h5"]), "a chunk of at most 8 MiB")

    def test_numbers_elsewhere_are_not_read(self, tmp_path: Path) -> None:
        with h5py.File(tmp_path / "a.h5", "w") as file:
            layout = h5py.VirtualLayout((2, 4, 4), "u1")
            layout[0] = h5py.VirtualSource("/dev/zero", "x", (4, 4))
            file.create_virtual_dataset("virtual", layout)
            file.create_dataset("external", (2, 4, 4), "u1", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
            file["link"] = h5py.ExternalLink("other.h5", "frames")
        for name in ("virtual", "external"):
            refused(partial(open_frames, [f"{tmp_path}/a.h5:{name}"]), "stored in other files")
        refused(lambda: open_frames([f"{tmp_path}/a.h5:link"]), "no array 'link'")


def test_matlab(tmp_path: Path) -> None:
    scipy.io.savemat(
        tmp_path / "a.mat", {"frames": np.zeros((64, 1024, 1024), np.uint8)}, do_compression=True
    )
    refused(lambda: open_frames([tmp_path / "a.mat"]), "a.mat", "of memory")


def test_gzip_of_nothing_but_zeros(tmp_path: Path) -> None:
    write(tmp_path / "slopes.fits", result())
    content = (tmp_path / "slopes.fits").read_bytes()
    (tmp_path / "slopes.fits.gz").write_bytes(gzip.compress(content.replace(b"       50", b" 99999999")))
    refused(lambda: read_slopes(tmp_path / "slopes.fits.gz"), "slopes.fits.gz")


@pytest.mark.parametrize("before", ["", "header", "slopes"])
def test_gzip_without_an_end(tmp_path: Path, before: str) -> None:
    """Zeros, or blanks in which a header does not end, of which astropy would read as long as some come."""
    write(tmp_path / "slopes.fits", result())
    content = (tmp_path / "slopes.fits").read_bytes()
    start = {"": b"", "header": content[:80], "slopes": content}[before]
    path = tmp_path / "a.fits.gz"
    path.write_bytes(gzip.compress(start + (b" " if before == "header" else b"\0") * (64 * MIB)))
    refused(lambda: read_slopes(path), "a.fits.gz")
    if before != "slopes":
        refused(lambda: open_frames([path]), "a.fits.gz")


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("ending", ["npz", "fits", "csv", "npy"])
def test_what_is_no_regular_file(tmp_path: Path, ending: str, kind: str) -> None:
    path = tmp_path / f"a.{ending}"
    replace(path, kind)
    readers = [open_frames_of, read_array, PSF.load, TrainedScore.load, read_reference]
    for read in readers if ending == "npy" else [*readers, read_slopes]:
        refused(partial(read, path), f"{path}: expected a regular file")


@pytest.mark.parametrize("name", ["x", "run.json", "finished"])
def test_unfinished_run(tmp_path: Path, name: str) -> None:
    folder = tmp_path / ".slopes.npz.partial"
    folder.mkdir()
    (folder / "run.json").write_text(
        json.dumps({"n_subapertures": 3, "attributes": {"fingerprint": "a"}, "coordinates": {}})
    )
    (folder / "finished").write_text("5\na")
    (folder / name).unlink(missing_ok=True)
    replace(folder / name, "pipe")
    refused(lambda: read_slopes(folder), str(tmp_path))


def open_frames_of(path: Path) -> Any:
    return open_frames([path])


def replace(path: Path, kind: str) -> None:
    """Make something without an end."""
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
