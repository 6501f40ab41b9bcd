"""Files of slopes of single formats."""

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from tests.io.slope_files import (
    ATTRIBUTES,
    assert_alone,
    assert_refused,
    begin,
    result,
    write,
    writer_for,
)
from tests.refusals import refused

from faintspot.base.errors import MissingExtraError
from faintspot.base.flags import VARIABLES
from faintspot.io import file_format, read_slopes
from faintspot.io.formats import csv_files

fits = pytest.importorskip("astropy.io.fits")


def test_xarray_reads_the_store(tmp_path: Path) -> None:
    """As the README says, without options; a warning is an error in these tests."""
    xarray = pytest.importorskip("xarray")
    whole = result()
    write(tmp_path / "slopes.zarr", whole)
    with xarray.open_zarr(tmp_path / "slopes.zarr") as dataset:
        assert dict(dataset.sizes) == {"frame": 50, "subaperture": 7}
        assert dataset["x"].dims == ("frame", "subaperture")
        assert set(dataset.coords) == {"centre_x", "centre_y"}
        assert dataset["x"].attrs["units"] == "px"
        assert dataset["flux"].attrs["units"] == "e-"
        assert dataset["centre_x"].attrs["units"] == "px"
        assert dataset["y"].attrs["long_name"]
        assert dataset.attrs["configuration"] == ATTRIBUTES["configuration"]
        assert dataset.attrs["sources"] == ["a.fits", "b.fits"]
        assert dataset.attrs["complete"] is True
        for name in VARIABLES:
            np.testing.assert_array_equal(dataset[name].values, whole[name])


@pytest.mark.parametrize("name", ["slopes.fits", "slopes.fits.gz"])
def test_astropy_reads_the_fits_file(tmp_path: Path, name: str) -> None:
    whole = result()
    write(tmp_path / name, whole)
    assert_alone(tmp_path / name, whole)
    if name.endswith(".gz"):  # compressed, and without the time, so that equal slopes give equal files
        assert (tmp_path / name).read_bytes()[:8] == b"\x1f\x8b\x08\0\0\0\0\0"
    with fits.open(tmp_path / name, checksum=True) as units:  # a warning is an error
        units.verify("exception")
        for unit in units:
            assert unit.verify_checksum() == unit.verify_datasum() == 1
        assert units[0].header["NFRAMES"] == 50
        assert units["X"].header["BUNIT"] == "px"
        np.testing.assert_array_equal(units["FLUX"].data, whole["flux"])
        np.testing.assert_array_equal(units["VALID"].data, whole["valid"])
        assert b"pixels = 16" in units["ATTRIBUTES"].data.tobytes()


def test_attributes_of_a_finished_output_are_not_measured_again(tmp_path: Path) -> None:
    calls = []

    def measured() -> dict[str, list[float]]:
        calls.append(1)
        return {"response": [1.0, 0.5]}

    for _ in range(2):
        write(tmp_path / "slopes.npz", result(), measured_attributes=measured)
        assert read_slopes(tmp_path / "slopes.npz").attributes["response"] == [1.0, 0.5]
    assert len(calls) == 1


def test_csv_is_a_plain_table(tmp_path: Path) -> None:
    whole = result()
    whole["x"][1, 2] = np.float32(0.1)
    write(tmp_path / "slopes.csv", whole)
    lines = (tmp_path / "slopes.csv").read_text().splitlines()
    assert lines[0] == (
        "frame,subaperture,x_px,y_px,flux_e,valid,flags,iterations,bad_pixels,"
        "standard_error_x_px,standard_error_y_px,covariance_xy_px2"
    )
    assert len(lines) == 1 + 50 * 7
    assert lines[1 + 7 + 2].startswith("1,2,0.1,")


@pytest.mark.slow
def test_csv_is_written_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As texts the whole table of 1,500 lines takes 1.3 MB, with a piece of 128 lines 0.35 MB."""
    monkeypatch.setattr(csv_files, "_LINES", 128)
    tracemalloc.start()
    try:
        write(tmp_path / "slopes.csv", result(20, 75), 10)
        assert tracemalloc.get_traced_memory()[1] < 800_000
    finally:
        tracemalloc.stop()


def test_damaged_chunk_of_a_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where all values are 0, which is the fill value."""
    monkeypatch.setattr("faintspot.io.formats.zarr_files._CHUNK_NUMBERS", 70)
    whole = result()
    whole["flags"][20:30] = 0
    store = tmp_path / "slopes.zarr"
    write(store, whole)
    for name, number in (("flags", "c.2.0"), ("centre_x", "c.0")):
        chunk = store / name / number
        content = chunk.read_bytes()
        wrong_bit = content[:5] + bytes([content[5] ^ 4]) + content[6:]
        for damaged in (b"", content[:9], wrong_bit, None):
            chunk.unlink() if damaged is None else chunk.write_bytes(damaged)
            with refused(f"{store}: ", f"damaged: {name} "):
                read_slopes(store)
        chunk.write_bytes(content)


def test_descriptions_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    for name, parts, changes in (
        ("slopes.txt", (".zarr", ".fits.gz", ".npz", ".csv"), {}),
        ("a.npz", ("fingerprint",), {"attributes": {}}),
        ("a.npz", ("complete",), {"attributes": {"fingerprint": "a", "complete": True}}),
        ("a.npz", ("object",), {"attributes": {"fingerprint": "a", "what": object()}}),
        ("a.npz", ("shape (7,)",), {"coordinates": {"centre_x": np.zeros(3)}}),
        ("a.npz", ("'x'",), {"coordinates": {"x": np.zeros(7)}}),
        ("a.npz", ("n_frames",), {"n_frames": 0}),
    ):
        assert_refused(tmp_path / name, *parts, **changes)
        assert not list(tmp_path.iterdir())


class TestWithoutZarr:
    """Slopes are kept in memory, and an interrupted run starts again."""

    @pytest.fixture(autouse=True)
    def no_package(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for module in ("zarr", "astropy.io.fits"):
            monkeypatch.setitem(sys.modules, module, None)

    @pytest.mark.parametrize("name", ["slopes.npz", "slopes.csv"])
    def test_written_at_the_end(self, tmp_path: Path, name: str) -> None:
        begin(tmp_path / name, 20)
        assert not list(tmp_path.iterdir())
        assert writer_for(tmp_path / name).finished() == 0
        write(tmp_path / name, result())
        assert_alone(tmp_path / name, result())

    @pytest.mark.parametrize("name", ["slopes.zarr", "slopes.fits", "slopes.fits.gz"])
    def test_format_that_needs_a_package(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(MissingExtraError, match=r"faintspot\[io\]"):
            writer_for(tmp_path / name)
        assert not list(tmp_path.iterdir())

    def test_store_that_a_run_with_zarr_left(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.undo()
        begin(tmp_path / "slopes.npz", 20)
        monkeypatch.setitem(sys.modules, "zarr", None)
        with pytest.raises(MissingExtraError, match=r"faintspot\[io\]"):
            writer_for(tmp_path / "slopes.npz")

    def test_more_than_fits_in_memory(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(file_format, "memory_bytes", lambda: 20_000)
        assert_refused(tmp_path / "slopes.npz", "of memory, expected slopes of at most")
