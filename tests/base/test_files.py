"""Files: what is written and read, and absurd sizes refused in one line before they take memory or time."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest
from tests.refusals import assert_all_refused, refusal, refused

import faintspot as fs
from faintspot.base import files
from faintspot.base.files import MOST_NUMBERS, check_size
from faintspot.experiments.study.specification import StudySpecification
from faintspot.experiments.study.sweep import Sweep
from faintspot.io import open_frames
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.slopes.spots.psf import PSF


@pytest.mark.parametrize("content", [b"\xc3\xa9\n", "é\n", lambda stream: stream.write(b"\xc3\xa9\n")])
def test_what_is_written(tmp_path: Path, content: files.Content) -> None:
    path = tmp_path / "a.txt"
    path.write_text("a longer text that was there before")
    files.write_atomically(path, content)
    assert path.read_text(encoding="utf-8") == "é\n"
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "usual").touch()
    files.write_atomically(tmp_path / "a", b"")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_names_of_derived_files() -> None:
    for name, expected in (
        ("night.toml", "night.psf.npz"),
        ("night.1.toml", "night.1.psf.npz"),
        ("night.1", "night.1.psf.npz"),  # not that of night.2
        ("night.1.fits.gz", "night.1.psf.npz"),
        ("night.control.NPZ", "night.control.psf.npz"),
    ):
        assert files.derived(f"a.b/{name}", ".psf.npz") == Path("a.b") / expected


def test_derived_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "night.zarr").mkdir()
    monkeypatch.chdir(tmp_path / "night.zarr")
    assert files.derived(".", ".csv") == tmp_path / "night.csv"
    with refused("/"):
        files.derived("/", ".csv")


def test_only_regular_files_of_a_known_size_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "file").write_bytes(bytes(10))
    for name, words in (("pipe", "a named pipe"), ("zero", "a device"), ("file", "at most 9")):
        with refused(name, words):
            files.read_bytes(tmp_path / name, "a file", 9)
    assert files.read_bytes(tmp_path / "file", "a file", 10) == bytes(10)
    with pytest.raises(IsADirectoryError):
        files.read_bytes(tmp_path, "a file", 9)


def test_content_is_on_disk_before_the_name_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    seen = []
    synchronise = os.fsync

    def watched(descriptor: int) -> None:
        seen.append(path.read_bytes())
        synchronise(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    files.write_atomically(path, b"new")
    assert seen == [b"old", b"new"]  # the file, then the folder


class TestThatFail:
    def test_old_content_stays(self, tmp_path: Path) -> None:
        path = tmp_path / "a"
        path.write_bytes(b"old")

        def interrupted(stream: BinaryIO) -> None:
            stream.write(b"half of")
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            files.write_atomically(path, interrupted)
        assert path.read_bytes() == b"old"
        assert list(tmp_path.iterdir()) == [path]

    def test_full_disk_leaves_no_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with refused("a.txt", "disk"):
            files.write_atomically(tmp_path / "a.txt", "text")
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(("name", "words"), [("b/a", "b does not exist"), ("a", "Is a directory")])
    def test_folders_that_are_absent_or_in_the_way(self, tmp_path: Path, name: str, words: str) -> None:
        (tmp_path / "a").mkdir()
        with refused(f"{name}: cannot be written: ", words):
            files.write_atomically(tmp_path / name, b"")
        assert list(tmp_path.iterdir()) == [tmp_path / "a"]

    @pytest.mark.parametrize(("number", "passes"), [(errno.EINVAL, True), (errno.EIO, False)])
    def test_folders_that_cannot_be_synchronised(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, passes: bool
    ) -> None:
        def refuse(_: Path) -> None:
            raise OSError(number, "error")

        monkeypatch.setattr(files, "sync_file", refuse)
        if passes:
            files.sync_folder(tmp_path)
        else:
            with pytest.raises(OSError, match="error"):
                files.sync_folder(tmp_path)


def of_text(text: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        path = folder / "faintspot.toml"
        path.write_text(text)
        return fs.SlopePipeline.from_file(path)

    return read


def with_cells(cells: Any) -> fs.Layout:
    return fs.Layout((64, 64), (8, 8), np.array([[0, 0], [9, 9]]), cells=cells)


def map_of(pixels: int, size: float, **options: Any) -> fs.SlopePipeline:
    layout = fs.Layout.grid((4, 4), pixels=pixels)
    psf = PSF.analytic("gaussian", size=size, radius_px=8)
    return fs.SlopePipeline(layout, fs.Settings("map", **options), fs.Calibration(read_noise_e=1.0), psf=psf)


def spread(points: int) -> Any:
    return np.linspace(1, 100, points).tolist()


CASES: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    "frame": (
        of_text("[layout]\nframe_shape = [1000000000, 1000000000]\nwindow = 8\ncorners = [[0, 0]]\n"),
        ("layout.frame_shape = 1000000000 x 1000000000", "268,435,456 pixels"),
    ),
    "grid": (of_text("[layout.grid]\nshape = [10000, 10000]\npixels = 16\n"), ("layout.grid.shape",)),
    "pitch": (lambda _: fs.Layout.grid((3, 3), pixels=8, pitch=10_000), ("frame_shape",)),
    "cells": (lambda _: with_cells([[0, 0], [1e300, 0]]), ("layout.cells = 1e+300",)),
    "map of cells": (lambda _: with_cells([[0, 0], [9999, 9999]]), ("layout.cells = 10000 x 10000",)),
    "posterior of many fluxes": (
        lambda _: map_of(64, 0.5, flux_e=np.linspace(10, 1000, 16)),
        ("map: tables of the posterior", "search_range_px", "one flux_e"),
    ),
    "posterior of any flux": (lambda _: map_of(64, 0.3), ("map: tables of the posterior",)),
    "psf's radius": (lambda _: PSF.analytic(radius_px=256), ("radius_px = 256",)),
    "psfs": (lambda _: PSF.analytic(size=np.ones(99), radius_px=128, index=range(99)), ("psf.samples",)),
    "psf's side": (lambda _: PSF(np.ones((5, 5001)), 8), ("psf.samples: expected at most 4097",)),
    "image": (lambda _: PSF.analytic().images([[0, 0]], (1 << 20, 1 << 20)), ("shape = 1048576 x",)),
    "spot": (lambda _: fs.slopes.simulate.spots([[0, 0]], shape=(1 << 20, 1 << 20)), ("shape = 1048576 x",)),
    "loop": (
        lambda _: LoopConfiguration().replace("sensor", subapertures=200, samples=128),
        ("subapertures x samples",),
    ),
    "study": (
        lambda _: StudySpecification(
            "s", [Sweep("s", flux_e=spread(1000), read_noise_e=spread(1000), background_e=spread(1000))]
        ),
        ("sweeps", "100,000 cells"),
    ),
}


def test_absurd_sizes_are_refused(tmp_path: Path) -> None:
    rows = ((name, names) for name, (_, names) in CASES.items())
    assert_all_refused(rows, lambda name: refusal(lambda: CASES[name][0](tmp_path)))


def test_flux_beyond_the_memory_uses_the_nearest_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faint and bright frames in turn: with room for few levels, all are measured, the first ones alike."""
    from faintspot.slopes.estimators.built_in import maximum_likelihood

    rng = np.random.default_rng(1)
    roomy, narrow = map_of(8, 0.8), map_of(8, 0.8)
    place = fs.slopes.simulate.spots(np.zeros((16, 2)), shape=(8, 8), size=0.8, profile="gaussian")
    bright = place.reshape(4, 4, 8, 8).swapaxes(1, 2).reshape(32, 32)
    frames = rng.poisson(np.multiply.outer([30, 300, 330, 3000], bright)) + rng.normal(0, 1, (4, 32, 32))
    room: Any = narrow.plan.prepared
    expected = [roomy(frame) for frame in frames]
    monkeypatch.setattr(maximum_likelihood, "MOST_NUMBERS", 2 * np.prod(room.table_shape))
    full = [narrow(frame) for frame in frames]
    assert len(room.tables.logarithms) == 2
    for place_in_turn in range(2):
        assert np.array_equal(full[place_in_turn].x, expected[place_in_turn].x)
    assert all(np.all(np.isfinite(slopes.x)) for slopes in full)


def test_sizes_up_to_the_limit_pass() -> None:
    check_size("frame", (1 << 14, 1 << 14))
    with refused("frame = 2 x 268435456", "268,435,456"):
        check_size("frame", (2, MOST_NUMBERS))


class TestFilesThatClaimMore:
    def test_frames_beyond_any_camera(self, tmp_path: Path) -> None:
        zarr = pytest.importorskip("zarr")
        path = tmp_path / "frames.zarr"
        zarr.create_array(str(path), shape=(2, 1 << 17, 1 << 17), chunks=(1, 1 << 14, 1 << 14), dtype="f4")
        with refused("131072 x 131072"):
            open_frames([path])
