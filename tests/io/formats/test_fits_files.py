import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io.frame_files import assert_frames, cube, fits, save
from tests.refusals import refused

from faintspot.io import open_frames, read_array


def written(path: Path, stored: Any, *cards: tuple[str, Any]) -> Path:
    """Write an image of stored numbers with these cards in its header."""
    bits = (-8 if stored.dtype.kind == "f" else 8) * stored.itemsize
    axes = [(f"NAXIS{axis}", side) for axis, side in enumerate(stored.shape[::-1], 1)]
    header = fits.Header([("SIMPLE", True), ("BITPIX", bits), ("NAXIS", stored.ndim), *axes, *cards])
    data = stored.astype(stored.dtype.newbyteorder(">")).tobytes()
    content = header.tostring().encode() + data + bytes(-len(data) % 2880)
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    return path


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
def test_scale_and_zero_as_astropy_has_them(tmp_path: Path, name: str) -> None:
    unit = fits.ImageHDU(cube(), name="SCI")
    unit.data[1, 2, 3] = -999
    unit.header["BSCALE"], unit.header["BZERO"], unit.header["BLANK"] = 0.5, 100.0, -999
    units = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 3)), name="DARK"), unit])
    units.writeto(tmp_path / name)
    with fits.open(tmp_path / name) as opened:
        expected = np.array(opened["SCI"].data, np.float32)
    for key in ("sci", "2"):
        assert_frames(f"{tmp_path / name}:{key}", expected)


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
def test_blank_becomes_nan(tmp_path: Path, name: str) -> None:
    stored = np.array([[[1, -7], [3, 4]]], np.int16)
    for zero, scale, blank, expected in (
        (1.0, 2.0, -7, [[[3.0, np.nan], [7.0, 9.0]]]),
        (0.0, 1.0, 1, [[[np.nan, -7.0], [3.0, 4.0]]]),
        (32768.0, 1.0, 3, [[[32769.0, 32761.0], [np.nan, 32772.0]]]),
    ):
        path = written(tmp_path / name, stored, ("BSCALE", scale), ("BZERO", zero), ("BLANK", blank))
        assert read_array(path).dtype == np.float32
        np.testing.assert_array_equal(read_array(path), expected)


def test_blank_of_numbers_that_are_not_whole_means_nothing(tmp_path: Path) -> None:
    frames = cube().astype(np.float32)
    frames[1, 2, 3] = 3.0
    assert_frames(written(tmp_path / "a.fits", frames, ("BLANK", 3)), frames)


@pytest.mark.parametrize("ending", ["fits", "fits.fz"])
def test_integers_of_the_other_sign_are_exact(tmp_path: Path, ending: str) -> None:
    for dtype in ("int8", "uint16", "uint32", *(("uint64", "int64") if ending == "fits" else ())):
        limits = np.iinfo(dtype)  # the compression does not know integers of 64 bits
        extremes = [limits.min, limits.min + 1, limits.max, limits.max // 2]
        values = np.array(extremes * 6, dtype).reshape(2, 3, 4)
        assert_frames(save(tmp_path / f"{dtype}.{ending}", values), values)
    values = np.linspace(-1, 1, 24).reshape(2, 3, 4)
    assert ending == "fits.fz" or assert_frames(save(tmp_path / "a.fits", values), values) == ""


def test_a_primary_image_of_one_number_is_not_the_frames(tmp_path: Path) -> None:
    frames = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    units = [fits.PrimaryHDU(np.zeros(1, np.int16)), fits.ImageHDU(frames)]
    fits.HDUList(units).writeto(tmp_path / "a.fits")
    np.testing.assert_array_equal(read_array(tmp_path / "a.fits"), frames)
    fits.HDUList(units[:1]).writeto(tmp_path / "b.fits")
    assert read_array(tmp_path / "b.fits").shape == (1,)


@pytest.mark.parametrize("kept", [0.5, 1.0])
def test_truncated_gzip_keeps_the_frames_before(tmp_path: Path, kept: float) -> None:
    """Either the frames are cut, or only the checksum at the end."""
    frames = cube(20, 40, 40)
    path = save(tmp_path / "a.fits.gz", frames)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept) - 4])
    with open_frames([path]) as source:
        np.testing.assert_array_equal(source.block(0, 5), frames[:5])
        with refused("a.fits.gz: frames 5 to 19 "):
            source.block(5, 20)
        np.testing.assert_array_equal(source.block(5, 7), frames[5:7])


ROWS = 500


def table(path: Path) -> dict[str, np.ndarray]:
    """Write a table with columns of numbers among others; return the numbers."""
    rng = np.random.default_rng(4)
    numbers = {
        "FrameCounter": np.arange(ROWS, dtype=np.uint32) + np.uint32(2**31 + 5),
        "Gradients": rng.standard_normal((ROWS, 34)).astype(np.float32),
        "Pair": rng.standard_normal((ROWS, 3, 2)),
        "Level": np.arange(ROWS, dtype=np.int16),
    }
    columns = [
        fits.Column("Text", "5A", array=["ab"] * ROWS),
        fits.Column("FrameCounter", "J", bzero=2**31, array=numbers["FrameCounter"]),
        fits.Column("Bits", "11X", array=np.ones((ROWS, 11), bool)),
        fits.Column("Gradients", "34E", array=numbers["Gradients"]),
        fits.Column("True", "L", array=np.ones(ROWS, bool)),
        fits.Column("Pair", "6D", dim="(2,3)", array=numbers["Pair"]),
        fits.Column("Level", "I", array=numbers["Level"]),
    ]
    units = [fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns, name="LoopFrame")]
    fits.HDUList(units).writeto(path)
    return numbers


@pytest.mark.parametrize("ending", ["fits", "fits.gz"])
def test_columns_of_a_table(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"loop.{ending}"
    for name, values in table(path).items():
        stored = read_array(f"{path}:{name.upper()}")
        np.testing.assert_array_equal(stored, values)
        assert stored.dtype == values.dtype
    named = "FrameCounter, Gradients, Pair, Level"
    for key in ("", ":LoopFrame", ":1", ":Text"):
        with refused(named):
            read_array(f"{path}{key}")


def test_two_columns_of_one_name(tmp_path: Path) -> None:
    path = tmp_path / "loop.fits"
    expected = table(path)["Level"]
    path.write_bytes(path.read_bytes().replace(b"'Text    '", b"'Level   '"))
    np.testing.assert_array_equal(read_array(f"{path}:Level"), expected)


def test_damaged_fits_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "loop.fits"
    table(path)
    content = path.read_bytes()
    size = len(fits.getheader(path, 1).tostring())
    for card, value in (
        *(("TFORM4", form) for form in ("340000000E", "5Y", "33E")),
        *(("NAXIS1", 2**40), ("NAXIS1", 7), ("NAXIS2", 2**40), ("TFIELDS", 3), ("TFIELDS", 10**9)),
        ("TSCAL4", "two"),
    ):
        header = fits.Header.fromstring(content[2880 : 2880 * 3].split(b" END ")[0])
        header[card] = value
        path.write_bytes(content[:2880] + header.tostring().encode() + content[2880 + size :])
        with refused("loop.fits"):
            read_array(f"{path}:Gradients")
            pytest.fail(f"{card} = {value} is accepted")
