from __future__ import annotations

import errno
import os
import shutil
import sys
import tracemalloc
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.io.slope_files import (
    ATTRIBUTES,
    NAMES,
    assert_refused,
    assert_stored,
    part,
    result,
    write,
    writer_for,
)

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.io import open_frames, read_slopes
from faintspot.io.formats import csv_files
from faintspot.io.stored import slopes_zarr
from faintspot.io.stored.slopes_format import VARIABLES, Variable

ERRORS = ("standard_error_x", "standard_error_y")
fits = pytest.importorskip("astropy.io.fits")
pytest.importorskip("zarr")


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten frames of seven sub-apertures a chunk."""
    monkeypatch.setattr(slopes_zarr, "_CHUNK_NUMBERS", 70)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("step", [8, 10])
@pytest.mark.usefixtures("small_chunks")
class TestRoundTrip:
    def test_every_format_gives_back_what_it_got(self, tmp_path: Path, name: str, step: int) -> None:
        whole = result()
        write(tmp_path / name, whole, step)
        assert_stored(tmp_path / name, whole)
        assert [entry.name for entry in tmp_path.iterdir()] == [name]

    def test_interrupted_and_resumed_is_the_same(self, tmp_path: Path, name: str, step: int) -> None:
        whole = result()
        path = tmp_path / name

        def interrupted() -> None:
            with writer_for(path) as writer:
                writer.append(0, part(whole, 0, 13))
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupted()
        if name.endswith(".zarr"):
            stored = read_slopes(path)
        else:
            assert not path.exists()
            with pytest.raises(InputError, match="unfinished run"):
                read_slopes(path)
            stored = read_slopes(path.with_name(f".{name}.partial"))
        assert (stored.complete, stored.n_finished) == (False, 13)
        np.testing.assert_array_equal(stored.variables["flux"], whole["flux"][:13])
        assert writer_for(path).finished() == 13
        write(path, whole, step)
        assert_stored(path, whole)
        assert [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", [name for name in NAMES if not name.endswith(".zarr")])
def test_equal_slopes_give_equal_files(tmp_path: Path, name: str) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / name, result())
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


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


def test_astropy_reads_the_fits_file(tmp_path: Path) -> None:
    whole = result()
    write(tmp_path / "slopes.fits", whole)
    with fits.open(tmp_path / "slopes.fits") as units:
        units.verify("exception")
        assert units[0].header["NFRAMES"] == 50
        assert units["X"].header["BUNIT"] == "px"
        np.testing.assert_array_equal(units["FLUX"].data, whole["flux"])
        np.testing.assert_array_equal(units["VALID"].data, whole["valid"])
        assert b"pixels = 16" in units["ATTRIBUTES"].data.tobytes()


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


@pytest.mark.parametrize("name", NAMES)
def test_standard_errors_that_are_not_given_are_infinite(tmp_path: Path, name: str) -> None:
    whole = result()
    write(tmp_path / name, {key: array for key, array in whole.items() if key not in ERRORS})
    unknown = np.full((50, 7), np.inf, np.float32)
    assert_stored(tmp_path / name, {**whole, **dict.fromkeys(ERRORS, unknown)})


@pytest.mark.parametrize("name", NAMES)
def test_a_file_without_covariances_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    whole = result()
    with monkeypatch.context() as before:
        before.delitem(cast("dict[str, Variable]", VARIABLES), "covariance_xy")
        write(tmp_path / name, {key: array for key, array in whole.items() if key != "covariance_xy"})
    assert_stored(tmp_path / name, {**whole, "covariance_xy": np.zeros((50, 7), np.float32)})


def test_slopes_are_read_as_frames_by_name(tmp_path: Path) -> None:
    write(tmp_path / "slopes.fits", result())
    with open_frames([f"{tmp_path / 'slopes.fits'}:X"]) as source:
        assert source.shape == (50, 7)


def test_formats_without_extra_and_those_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("slopes_fits", "slopes_zarr"):
        monkeypatch.delitem(sys.modules, f"faintspot.io.{module}", raising=False)
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    monkeypatch.setitem(sys.modules, "zarr", None)
    for name in ("slopes.npz", "slopes.csv"):
        write(tmp_path / name, result())
        assert_stored(tmp_path / name, result())
    for name in ("slopes.zarr", "slopes.fits", "slopes.fits.gz"):
        with pytest.raises(MissingExtraError, match=r"faintspot\[io\]"):
            writer_for(tmp_path / name)
    assert len(list(tmp_path.iterdir())) == 2


class TestOutputThatExists:
    @pytest.mark.parametrize("name", NAMES)
    def test_other_run(self, tmp_path: Path, name: str) -> None:
        path = tmp_path / name
        other = {**ATTRIBUTES, "fingerprint": "other"}
        with writer_for(path) as writer:
            writer.append(0, part(result(), 0, 8))
        assert_refused(path, "another run", "--overwrite", attributes=other)
        assert_refused(path, "another run", n_frames=51)
        assert_refused(path, "already exists", resume=False)
        assert writer_for(path, resume=False, overwrite=True).finished() == 0
        write(path, result())
        assert_refused(path, "--overwrite", attributes=other)
        assert_refused(path, "already exists", "--overwrite", resume=False)
        assert_stored(path, result())
        changed = {**result(), "x": result()["y"]}
        write(path, changed, overwrite=True)
        assert_stored(path, changed)

    @pytest.mark.parametrize("name", NAMES)
    def test_same_run_that_is_complete(self, tmp_path: Path, name: str) -> None:
        write(tmp_path / name, result())
        if name.endswith(".csv"):
            assert_refused(tmp_path / name, "already exists")
            return
        with writer_for(tmp_path / name) as writer:
            assert writer.finished() == 50
            with pytest.raises(InputError, match=r"complete|more frames"):
                writer.append(50, part(result(), 0, 1))
        assert_stored(tmp_path / name, result())

    def test_old_file_stays_until_the_new_one_is_whole(self, tmp_path: Path) -> None:
        path = tmp_path / "slopes.npz"
        write(path, result())
        changed = {**result(), "x": result()["y"]}
        with writer_for(path, overwrite=True) as writer:
            writer.append(0, part(changed, 0, 49))
        assert_stored(path, result())
        with writer_for(path, overwrite=True) as writer:
            assert writer.finished() == 49
            writer.append(49, part(changed, 49, 50))
        assert_stored(path, changed)

    def test_ended_between_making_the_file_and_tidying_up(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def end(*_: Any) -> None:
            raise KeyboardInterrupt

        path = tmp_path / "slopes.npz"
        writer = writer_for(path)
        writer.append(0, result())
        with monkeypatch.context() as patch:
            patch.setattr(shutil, "rmtree", end)
            with pytest.raises(KeyboardInterrupt):
                writer.close()
        assert len(list(tmp_path.iterdir())) == 2
        assert writer_for(path).finished() == 50
        assert list(tmp_path.iterdir()) == [path]
        assert_stored(path, result())

    def test_finished_run_leaves_another_ones_partial_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "slopes.npz"
        write(path, result())
        other: dict[str, Any] = {"attributes": {**ATTRIBUTES, "fingerprint": "other"}, "overwrite": True}
        writer_for(path, **other).append(0, part(result(), 0, 8))
        assert writer_for(path).finished() == 50
        assert writer_for(path, **other).finished() == 8

    def test_damaged_leftovers(self, tmp_path: Path) -> None:
        writer_for(tmp_path / "a.npz")
        (tmp_path / ".a.npz.partial" / "finished").write_text("")
        assert_refused(tmp_path / "a.npz", "damaged", "delete it")
        (tmp_path / ".a.npz.partial" / "run.json").write_text("{")
        assert_refused(tmp_path / "a.npz", "damaged", "delete it")
        writer_for(tmp_path / "a.zarr")
        shutil.rmtree(tmp_path / "a.zarr" / "flux")
        assert_refused(tmp_path / "a.zarr", "damaged", "delete it", "flux")

    def test_things_that_are_no_slopes(self, tmp_path: Path) -> None:
        (tmp_path / "a.zarr").mkdir()
        (tmp_path / "b.zarr").touch()
        (tmp_path / "a.npz").mkdir()
        (tmp_path / "b.npz").write_text("text")
        for name in ("a.zarr", "b.zarr"):
            assert_refused(tmp_path / name, "expected slopes", overwrite=True)
        assert_refused(tmp_path / "a.npz", "already exists")
        assert_refused(tmp_path / "b.npz", "expected slopes")
        for name in ("a.zarr", "b.npz", "c.fits"):
            with pytest.raises(InputError):
                read_slopes(tmp_path / name)


class TestRefused:
    def test_names_and_folders(self, tmp_path: Path) -> None:
        assert_refused(tmp_path / "slopes.txt", ".zarr, .fits, .fits.gz, .npz or .csv")
        for name in NAMES:
            assert_refused(tmp_path / "none" / name, "does not exist")
        assert_refused(tmp_path / "a.npz", "fingerprint", attributes={})
        assert_refused(tmp_path / "a.npz", "complete", attributes={"fingerprint": "a", "complete": True})
        assert_refused(tmp_path / "a.npz", "object", attributes={"fingerprint": "a", "what": object()})
        assert_refused(tmp_path / "a.npz", "shape (7,)", coordinates={"centre_x": np.zeros(3)})
        assert_refused(tmp_path / "a.npz", "'x'", coordinates={"x": np.zeros(7)})
        assert_refused(tmp_path / "a.npz", "n_frames", n_frames=0)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("name", ["slopes.zarr", "slopes.npz"])
    def test_blocks(self, tmp_path: Path, name: str) -> None:
        writer = writer_for(tmp_path / name)
        whole = result()
        wrong: list[tuple[int, dict[str, NDArray[Any]], str]] = [
            (3, part(whole, 3, 5), "starts at frame 0"),
            (0, {**part(whole, 0, 5), "y": whole["y"][:4]}, "y: expected shape"),
            (0, {"x": whole["x"]}, "expected x, y, flux"),
            (0, result(51), "1 to 50 more frames, got 51"),
            (0, part(whole, 0, 0), "got 0"),
        ]
        for start, block, text in wrong:
            with pytest.raises(InputError, match=text):
                writer.append(start, block)
        assert writer.finished() == 0

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
    @pytest.mark.parametrize("name", NAMES)
    def test_folder_without_permission(self, tmp_path: Path, name: str) -> None:
        folder = tmp_path / "locked"
        folder.mkdir(mode=0o500)
        assert_refused(folder / name, "no permission")

    @pytest.mark.parametrize("name", ["slopes.zarr", "slopes.npz"])
    def test_read_only_file_system(self, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: Any, **__: Any) -> None:
            raise OSError(errno.EROFS, "Read-only file system")

        monkeypatch.setattr(Path, "mkdir", refuse)
        assert_refused(tmp_path / name, "read-only", "choose another folder")


def test_csv_is_written_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As texts the whole table of 30,000 lines takes more than 10 MB, a piece of 256 lines 0.2 MB."""
    monkeypatch.setattr(csv_files, "_LINES", 256)
    whole = result(300, 100)
    tracemalloc.start()
    try:
        write(tmp_path / "slopes.csv", whole, 10)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1_500_000


@pytest.mark.parametrize("name", NAMES[:-1])
def test_memory_does_not_grow_with_the_run(tmp_path: Path, name: str) -> None:
    """2,000 frames of 200 sub-apertures are 12 MB; a block, a chunk and buffers are less than 8.5 MB."""
    block = result(100, 200)
    with writer_for(tmp_path / name, 100, 200) as writer:  # imports and codecs are loaded once
        writer.append(0, block)
    path = tmp_path / f"long_{name}"
    tracemalloc.start()
    try:
        with writer_for(path, 2000, 200) as writer:
            for start in range(0, 2000, 100):
                writer.append(start, block)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 8_500_000
