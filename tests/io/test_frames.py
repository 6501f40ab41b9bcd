from __future__ import annotations

import gzip
import re
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.io.frame_files import FORMATS, cube, save
from tests.refusals import refused
from tests.shared_data import shared_file

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.io import open_frames, read_array

fits = pytest.importorskip("astropy.io.fits")
zarr = pytest.importorskip("zarr")


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("dtype", ["int16", "float32", "uint8"])
def test_blocks_of_every_format_are_the_frames(tmp_path: Path, name: str, dtype: str) -> None:
    frames = cube(dtype=dtype)
    with open_frames([save(tmp_path / f"a.{name}", frames)]) as source:
        assert (source.n_frames, source.shape, source.dtype) == (11, (6, 8), frames.dtype)
        for start, stop in [(0, 4), (4, 5), (8, 11), (2, 7), (0, 11)]:  # forward, back and the whole
            block = source.block(start, stop)
            assert block.dtype == frames.dtype
            assert block.dtype.isnative
            np.testing.assert_array_equal(block, frames[start:stop])
        assert [start for start, _ in source.blocks(2, 11, 4)] == [2, 6, 10]


@pytest.mark.parametrize(
    "name", ["npy", "fortran.npy", "npz", "fits", "fits.gz", "stack.tif", "deflated.tif"]
)
def test_two_dimensions_are_one_frame(tmp_path: Path, name: str) -> None:
    frame = cube()[0]
    with open_frames([save(tmp_path / f"a.{name}", frame)]) as source:
        assert source.n_frames == 1
        np.testing.assert_array_equal(source.block(0, 1), frame[np.newaxis])


def test_fortran_order_image_in_npz(tmp_path: Path) -> None:
    frame = np.asfortranarray(cube()[0])
    np.savez(tmp_path / "a.npz", frame)
    np.testing.assert_array_equal(read_array(tmp_path / "a.npz"), frame)
    np.savez(tmp_path / "b.npz", np.asfortranarray(cube()))
    with refused("b.npz:arr_0", "Fortran order", "ascontiguousarray"):
        open_frames([tmp_path / "b.npz"])


@given(st.data())
@settings(max_examples=25, deadline=None)
def test_concatenation_of_files_equals_one_sequence(
    tmp_path_factory: pytest.TempPathFactory, data: Any
) -> None:
    folder = tmp_path_factory.mktemp("parts")
    counts = data.draw(st.lists(st.integers(1, 4), min_size=1, max_size=4))
    frames = cube(sum(counts))
    names = data.draw(
        st.lists(st.sampled_from(["npy", "npz", "fits.gz"]), min_size=len(counts), max_size=len(counts))
    )
    ends = np.cumsum(counts)
    paths = [
        save(folder / f"{i}.{name}", frames[end - count : end])
        for i, (name, count, end) in enumerate(zip(names, counts, ends, strict=True))
    ]
    start = data.draw(st.integers(0, len(frames) - 1))
    stop = data.draw(st.integers(start + 1, len(frames)))
    with open_frames(paths) as source:
        assert source.n_frames == len(frames)
        np.testing.assert_array_equal(source.block(start, stop), frames[start:stop])


def test_different_types_are_promoted(tmp_path: Path) -> None:
    paths = [save(tmp_path / "a.npy", cube()), save(tmp_path / "b.npy", cube(dtype="float32"))]
    with open_frames(paths) as source:
        assert source.dtype == np.float32
        assert source.block(0, 1).dtype == np.float32
        assert source.description.endswith("a.npy and 1 more")


def test_big_endian_becomes_native(tmp_path: Path) -> None:
    frames = cube()
    np.save(tmp_path / "a.npy", frames.astype(">i2"))
    with open_frames([tmp_path / "a.npy"]) as source:
        assert source.dtype.isnative
        np.testing.assert_array_equal(source.block(0, 11), frames)


class TestFits:
    @pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
    def test_scale_zero_and_blank_as_astropy_has_them(self, tmp_path: Path, name: str) -> None:
        unit = fits.ImageHDU(cube(), name="SCI")
        unit.data[1, 2, 3] = -999
        unit.header["BSCALE"], unit.header["BZERO"], unit.header["BLANK"] = 0.5, 100.0, -999
        stored = cube()
        stored[1, 2, 3] = -999
        units = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 3)), name="DARK"), unit])
        units.writeto(tmp_path / name)
        with fits.open(tmp_path / name) as opened:
            expected = np.array(opened["SCI"].data)
        for location in (f"{tmp_path / name}:sci", f"{tmp_path / name}:2"):
            with open_frames([location]) as source:
                np.testing.assert_array_equal(source.block(0, 11), expected)

    def test_blank_of_numbers_that_are_not_whole_means_nothing(self, tmp_path: Path) -> None:
        header = fits.Header([("BLANK", 3)])
        frames = cube().astype(np.float32)
        frames[1, 2, 3] = 3.0
        fits.HDUList([fits.PrimaryHDU(frames, header)]).writeto(tmp_path / "a.fits", output_verify="ignore")
        content = (tmp_path / "a.fits").read_bytes()
        assert b"BLANK " in content
        np.testing.assert_array_equal(read_array(tmp_path / "a.fits"), frames)

    def test_blank_becomes_nan(self, tmp_path: Path) -> None:
        header = fits.Header([("BLANK", -7), ("BSCALE", 2.0), ("BZERO", 1.0)])
        stored = np.array([[[1, -7], [3, 4]]], np.int16)
        raw = fits.PrimaryHDU(stored)
        raw.writeto(tmp_path / "a.fits")
        content = bytearray((tmp_path / "a.fits").read_bytes())
        cards = "".join(card.image for card in header.cards).encode()
        end = content.index(b"END" + b" " * 77)
        content[end : end + len(cards) + 80] = cards + b"END" + b" " * 77
        (tmp_path / "a.fits").write_bytes(content)
        values = read_array(tmp_path / "a.fits")
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values, [[[3.0, np.nan], [7.0, 9.0]]])

    @pytest.mark.parametrize("dtype", ["int8", "uint16", "uint32", "uint64", "float64", "int64"])
    def test_integers_of_the_other_sign_are_exact(self, tmp_path: Path, dtype: str) -> None:
        if dtype.startswith("f"):
            values = np.linspace(-1, 1, 24).reshape(2, 3, 4)
        else:
            limits = np.iinfo(dtype)
            values = np.array([limits.min, limits.min + 1, limits.max, limits.max // 2] * 6, dtype).reshape(
                2, 3, 4
            )
        fits.PrimaryHDU(values).writeto(tmp_path / "a.fits")
        result = read_array(tmp_path / "a.fits")
        assert result.dtype == values.dtype
        np.testing.assert_array_equal(result, values)

    def test_negative_shape(self, tmp_path: Path) -> None:
        """Two of them make a size that a file can have."""
        path = tmp_path / "a.npy"
        header = {"descr": "<f4", "fortran_order": True, "shape": (-3, -4)}
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, header)
            file.write(bytes(48))
        with (
            pytest.raises(InputError, match=r"damaged: its header has the shape \(-3, -4\)"),
            open_frames([path]),
        ):
            pass

    def test_truncated_file(self, tmp_path: Path) -> None:
        path = save(tmp_path / "a.fits", cube(100, 20, 20))
        path.write_bytes(path.read_bytes()[:40_000])
        with refused("a.fits: truncated", "82880", "40000"):
            open_frames([path])

    def test_truncated_tile_compressed_file(self, tmp_path: Path) -> None:
        path = save(tmp_path / "a.fits.fz", cube(100, 20, 20))
        path.write_bytes(path.read_bytes()[:-40_000])
        with refused("truncated"):
            open_frames([path])

    def test_damaged_tile(self, tmp_path: Path) -> None:
        path = tmp_path / "a.fits.fz"
        fits.CompImageHDU(cube(100, 20, 20), compression_type="GZIP_1", tile_shape=(1, 20, 20)).writeto(path)
        content = bytearray(path.read_bytes())
        content[40_000:50_000] = bytes(10_000)
        path.write_bytes(content)
        with refused("a.fits.fz", "frames", "damaged"), open_frames([path]) as source:
            for _ in source.blocks(0, 100, 10):
                pass

    def test_no_such_extension_no_image_no_fits(self, tmp_path: Path) -> None:
        path = save(tmp_path / "a.fits", cube())
        with refused("'SCI'", "PRIMARY"):
            open_frames([path], key="SCI")
        table = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.zeros(3))], name="TAB")
        fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "t.fits")
        for key in (None, "TAB"):
            with refused("t.fits", "image"):
                open_frames([tmp_path / "t.fits"], key=key)
        (tmp_path / "b.fits").write_bytes(b"SIMPLE  but no header" * 300)
        with refused("b.fits", "FITS"):
            open_frames([tmp_path / "b.fits"])
        (tmp_path / "c.fits.gz").write_bytes(gzip.compress(b"no header" * 300))
        with refused("c.fits.gz", "FITS"):
            open_frames([tmp_path / "c.fits.gz"])

    def test_zero_frames(self, tmp_path: Path) -> None:
        unit = fits.PrimaryHDU(np.zeros((1, 4, 4), np.int16))
        unit.writeto(tmp_path / "a.fits")
        content = (tmp_path / "a.fits").read_bytes()
        assert re.search(rb"NAXIS3  = +1", content)
        (tmp_path / "a.fits").write_bytes(
            content.replace(b"NAXIS3  =                    1", b"NAXIS3  =                    0")
        )
        with refused("at least one frame", "(0, 4, 4)"):
            open_frames([tmp_path / "a.fits"])


class TestRefused:
    @pytest.mark.parametrize(
        ("array", "parts"),
        [
            (np.zeros((2, 3, 4), complex), ("dtype complex128",)),
            (np.zeros((2, 3, 4), "U3"), ("dtype <U3",)),
            (np.zeros((2, 3, 4), bool), ("dtype bool",)),
            (np.zeros((2, 2, 3, 4)), ("(2, 2, 3, 4)",)),
            (np.zeros(5), ("(5,)",)),
            (np.zeros((0, 3, 4)), ("at least one frame", "(0, 3, 4)")),
            (np.array([[None]]), ("Python objects",)),
            (np.float64(3), ("single number",)),
        ],
    )
    @pytest.mark.parametrize("ending", ["npy", "npz"])
    def test_arrays_that_are_no_frames(
        self, tmp_path: Path, array: NDArray[Any], parts: tuple[str, ...], ending: str
    ) -> None:
        path = tmp_path / f"a.{ending}"
        if ending == "npy":
            np.save(path, array, allow_pickle=True)
        else:
            np.savez(path, frames=array)
        with refused(path.name, *parts):
            open_frames([path])

    def test_paths(self, tmp_path: Path) -> None:
        (tmp_path / "empty.fits").touch()
        (tmp_path / "text.txt").write_text("some text")
        (tmp_path / "folder").mkdir()
        (tmp_path / "short.npy").write_bytes(b"\x93NUMPY")
        cut = save(tmp_path / "cut.npy", cube())
        cut.write_bytes(cut.read_bytes()[:-10])
        cases = {
            "missing.fits": "no such file",
            "missing.npz:frames": "no such file",
            "empty.fits": "empty",
            "text.txt": "HDF5 or MATLAB file or a Zarr store",
            "folder": "expected a Zarr store",
            "short.npy": "expected a NumPy array",
            "cut.npy": "truncated",
            "cut.npy:frames": "one unnamed",
        }
        for name, part in cases.items():
            with refused(name.partition(":")[0], part):
                open_frames([tmp_path / name])
        with pytest.raises(InputError, match="at least one file"):
            open_frames([])

    def test_names_in_archives_and_stores(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", one=cube(), two=cube(), flat=np.ones(3))
        group = zarr.create_group(str(tmp_path / "a.zarr"))
        group.create_array("one", data=cube())
        group.create_array("two", data=cube())
        for path in (tmp_path / "a.npz", tmp_path / "a.zarr"):
            with refused(path.name, "one", "two", f"{path.name}:NAME"):
                open_frames([path])
            with refused(path.name, "three"):
                open_frames([f"{path}:three"])
            with open_frames([path], key="two") as source:
                assert source.n_frames == 11

    def test_other_size_and_range(self, tmp_path: Path) -> None:
        a, b = save(tmp_path / "a.npy", cube()), save(tmp_path / "b.npy", cube(2, 6, 9))
        with refused("b.npy", "6 x 9", "a.npy", "6 x 8"):
            open_frames([a, b])
        with open_frames([a]) as source:
            for start, stop in [(-1, 2), (3, 3), (5, 12)]:
                with pytest.raises(InputError, match="expected 0 to 11"):
                    source.block(start, stop)

    def test_missing_extra(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        paths = {
            "astropy": save(tmp_path / "a.fits", cube()),
            "tifffile": save(tmp_path / "a.tif", cube()),
            "zarr": save(tmp_path / "v3.zarr", cube()),
        }
        monkeypatch.setitem(sys.modules, "astropy.io", None)
        monkeypatch.setitem(sys.modules, "tifffile", None)
        monkeypatch.setitem(sys.modules, "zarr", None)
        for package, path in paths.items():
            with pytest.raises(MissingExtraError, match=rf"{package}.*faintspot\[io\]"):
                open_frames([path])


class TestReadArray:
    def test_any_dimensions_and_bool(self, tmp_path: Path) -> None:
        mask = cube()[0] > 0
        np.savez(tmp_path / "a.npz", mask=mask, line=np.arange(5.0))
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:mask"), mask)
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:line"), np.arange(5.0))
        np.testing.assert_array_equal(read_array(f"{save(tmp_path / 'group.zarr', cube())}:dark"), cube()[0])
        zarr.open_group(str(tmp_path / "deep.zarr")).create_array("night/dark", data=mask)
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'deep.zarr'}:night/dark"), mask)

    @pytest.mark.parametrize("array", [np.zeros((2, 2), complex), np.zeros((0, 3)), np.float64(1)])
    def test_refused(self, tmp_path: Path, array: NDArray[Any]) -> None:
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(InputError, match="expected"):
            read_array(tmp_path / "a.npy")


class TestRealFiles:
    @pytest.mark.parametrize("name", ["mmirs_wfs_0150", "auto_wfs_0037_ave", "test_newf9"])
    def test_sky_frames(self, name: str) -> None:
        path = shared_file(f"data/{name}.fits.gz")
        with open_frames([path]) as source, fits.open(path) as units:
            expected = next(unit.data for unit in units if unit.data is not None)
            np.testing.assert_array_equal(source.block(0, source.n_frames)[0], expected)

    @pytest.mark.parametrize("name", ["ciao_bench_60x224x224", "ciao_bench_edge_60x56x224"])
    def test_bench_frames(self, name: str) -> None:
        path = shared_file(f"data/{name}.npz")
        with open_frames([path]) as source, np.load(path) as archive:
            whole = np.concatenate([block for _, block in source.blocks(0, 60, 7)])
            np.testing.assert_array_equal(whole, archive["frames"])


def test_zip_with_other_files_in_it(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", cube())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "hello")
    with open_frames([path]) as source:
        assert source.n_frames == 11


def test_more_pixels_than_a_frame_may_have(tmp_path: Path) -> None:
    """Of one byte each they are less memory than is allowed; what is made of them is more."""
    np.lib.format.open_memmap(tmp_path / "map.npy", "w+", np.uint8, (1 << 14, 1 << 15))  # no disk is used
    with refused("16384 x 32768"):
        read_array(tmp_path / "map.npy")
