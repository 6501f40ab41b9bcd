"""What every format of slopes must do."""

import errno
import os
import shutil
import tracemalloc
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from tests.io.slope_files import (
    ATTRIBUTES,
    NAMES,
    OTHER_RUN,
    assert_alone,
    assert_refused,
    assert_stored,
    begin,
    part,
    result,
    store_of,
    write,
    writer_for,
)
from tests.patience import mostly_slow
from tests.refusals import refused

from faintspot.base import files
from faintspot.base.errors import InputError
from faintspot.base.flags import VARIABLES, Variable
from faintspot.io import read_slopes, slopes_writer, zarr_store
from faintspot.io.formats import zarr_files

CHANGED = {**result(), "x": result()["y"]}


@pytest.fixture
def path(tmp_path: Path, name: str) -> Path:
    return tmp_path / name


@pytest.fixture
def is_store(path: Path) -> bool:
    return store_of(path) == path


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten frames of seven sub-apertures a chunk."""
    monkeypatch.setattr(zarr_files, "_CHUNK_NUMBERS", 70)


@pytest.fixture
def all_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mark after every chunk."""
    monkeypatch.setattr(slopes_writer, "_MARK_SECONDS", 0.0)


class TestEveryFormat:
    @pytest.fixture(params=mostly_slow(1, NAMES))
    def name(self, request: pytest.FixtureRequest) -> str:
        return str(request.param)

    # Content ----------------------------------------------------------------------------------------

    def test_equal_slopes_give_equal_files(self, path: Path, is_store: bool) -> None:
        if is_store:
            return
        write(path, result())
        content = path.read_bytes()
        write(path, result(), overwrite=True)
        assert path.read_bytes() == content

    def test_standard_errors_that_are_not_given_are_infinite(self, path: Path) -> None:
        errors = ("standard_error_x", "standard_error_y")
        write(path, {name: values for name, values in result().items() if name not in errors})
        unknown = np.full((50, 7), np.inf, np.float32)
        assert_stored(path, {**result(), **dict.fromkeys(errors, unknown)})

    def test_a_file_without_covariances_is_read(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        whole = result()
        covariance = whole.pop("covariance_xy")
        with monkeypatch.context() as before:
            before.delitem(cast("dict[str, Variable]", VARIABLES), "covariance_xy")
            write(path, whole)
        assert_stored(path, {**whole, "covariance_xy": np.zeros_like(covariance)})

    @pytest.mark.slow
    def test_memory_does_not_grow_with_the_run(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """While 24 MB of slopes are written; measuring texts takes too long."""
        if path.suffix == ".csv":
            return
        monkeypatch.setattr(zarr_files, "_CHUNK_NUMBERS", 1 << 16)
        block = result(100, 200)
        with writer_for(path.with_name(f"first_{path.name}"), 100, 200) as writer:  # imports and codecs
            writer.append(0, block)
        tracemalloc.start()
        try:
            with writer_for(path, 4000, 200) as writer:
                for start in range(0, 4000, 100):
                    writer.append(start, block)
            assert tracemalloc.get_traced_memory()[1] < 18_000_000  # blocks, chunks, buffers
        finally:
            tracemalloc.stop()

    # Interruptions ----------------------------------------------------------------------------------

    def test_interrupted_and_resumed_is_the_same(self, path: Path, is_store: bool) -> None:
        def interrupted() -> None:
            with writer_for(path) as writer:
                writer.append(0, part(result(), 0, 13))
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupted()
        if not is_store:
            with refused("no such file; an unfinished run left", str(store_of(path))):
                read_slopes(path)
        stored = read_slopes(store_of(path))
        assert (stored.complete, stored.n_finished) == (False, 13)
        np.testing.assert_array_equal(stored.variables["flux"], result()["flux"][:13])
        assert writer_for(path).finished() == 13
        write(path, result(), 8)
        assert_alone(path, result())

    def test_file_cannot_be_made(self, path: Path, is_store: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        if is_store:
            return
        synchronise = os.fsync

        def full(descriptor: int) -> None:
            name = Path(f"/proc/self/fd/{descriptor}").resolve().name
            if name.startswith(f".{path.name}.") and "zarr" not in name:
                raise OSError(errno.ENOSPC, "No space left on device")
            synchronise(descriptor)

        with monkeypatch.context() as patch, refused(path.name, "disk is full"):
            patch.setattr(os, "fsync", full)
            write(path, result())
        assert [entry.name for entry in path.parent.iterdir()] == [store_of(path).name]
        assert writer_for(path).finished() == 50
        write(path, result())
        assert_alone(path, result())

    def test_ended_between_making_the_file_and_removing_the_store(
        self, path: Path, is_store: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def end(*_: Any) -> None:
            raise KeyboardInterrupt

        if is_store:
            return
        writer = writer_for(path)
        writer.append(0, result())
        with monkeypatch.context() as patch:
            patch.setattr(slopes_writer, "remove_store", end)
            with pytest.raises(KeyboardInterrupt):
                writer.close()
        assert store_of(path).exists()
        if path.suffix == ".csv":  # does not identify its run
            assert_refused(path, "already exists")
        else:
            assert writer_for(path).finished() == 50
            assert_alone(path, result())

    # Existing outputs -------------------------------------------------------------------------------

    def test_other_run(self, path: Path) -> None:
        begin(path, 8)
        assert_refused(path, "another run", "--overwrite", attributes=OTHER_RUN)
        assert_refused(path, "another run", n_frames=51)
        write(path, result())
        assert_refused(path, "--overwrite", attributes=OTHER_RUN)
        assert_stored(path, result())
        write(path, CHANGED, overwrite=True)
        assert_alone(path, CHANGED)

    def test_same_run_that_is_complete(self, path: Path) -> None:
        write(path, result())
        if path.suffix == ".csv":
            assert_refused(path, "already exists")
            return
        with writer_for(path) as writer:
            assert writer.finished() == 50
            with refused("complete"):
                writer.append(50, part(result(), 0, 1))
        assert_alone(path, result())

    def test_old_file_stays_until_the_new_one_is_whole(self, path: Path, is_store: bool) -> None:
        if is_store:
            return
        write(path, result())
        with writer_for(path, overwrite=True) as writer:
            writer.append(0, part(CHANGED, 0, 49))
        assert_stored(path, result())
        with writer_for(path, overwrite=True) as writer:
            assert writer.finished() == 49
            writer.append(49, part(CHANGED, 49, 50))
        assert_alone(path, CHANGED)

    def test_finished_run_leaves_the_store_of_another_one(self, path: Path, is_store: bool) -> None:
        if is_store or path.suffix == ".csv":
            return
        write(path, result())
        other: dict[str, Any] = {"attributes": OTHER_RUN, "overwrite": True}
        begin(path, 8, **other)
        assert writer_for(path).finished() == 50
        assert writer_for(path, **other).finished() == 8

    @pytest.mark.parametrize("kind", ["folder", "text"])
    def test_path_of_something_else(self, path: Path, is_store: bool, kind: str) -> None:
        if kind == "folder":
            path.mkdir()
        else:
            path.write_text("text")
        assert_refused(path, path.name, *(["expected slopes"] if is_store else []))
        with refused(path.name):
            read_slopes(path)
        assert path.exists()

    # Other programs and damage ----------------------------------------------------------------------

    def test_one_wrong_bit_anywhere(self, path: Path, is_store: bool) -> None:
        """Refused, or the slopes that were written: blocks are filled up, and time stamps are not read."""
        if is_store or path.suffix not in (".npz", ".fits", ".gz"):
            return
        write(path, result())
        content = path.read_bytes()
        generator = np.random.default_rng(5)
        messages = []
        for position in generator.integers(0, len(content), 40):
            damaged = bytearray(content)
            damaged[position] ^= 1 << int(generator.integers(8))
            path.write_bytes(damaged)
            try:
                stored = read_slopes(path)
            except InputError as error:
                messages.append(str(error))
                continue
            for name, values in result().items():
                np.testing.assert_array_equal(stored.variables[name], values)
            assert stored.attributes["sources"] == ATTRIBUTES["sources"]
        assert len(messages) > 20
        assert all(message.startswith(str(path)) and "\n" not in message for message in messages)

    # Folders ----------------------------------------------------------------------------------------

    def test_missing_folder(self, tmp_path: Path, name: str) -> None:
        assert_refused(tmp_path / "none" / name, "does not exist")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
    def test_folder_without_permission(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "locked").mkdir(mode=0o500)
        assert_refused(tmp_path / "locked" / name, "no permission")


class TestStore:
    """The store that a run writes first, whatever its format."""

    @pytest.fixture(params=["slopes.zarr", "slopes.npz"])
    def name(self, request: pytest.FixtureRequest) -> str:
        return str(request.param)

    def test_wrong_blocks(self, path: Path) -> None:
        whole = result()
        with writer_for(path) as writer:
            for start, block, names in (
                (3, part(whole, 3, 5), ("frame 0",)),
                (0, {**part(whole, 0, 5), "y": whole["y"][:4]}, ("y", "(4, 7)")),
                (0, {"x": whole["x"]}, ("x, y, flux",)),
                (0, result(51), ("50", "51")),
                (0, part(whole, 0, 0), ("0",)),
            ):
                with refused(*names):
                    writer.append(start, block)
                assert writer.finished() == 0

    @pytest.mark.usefixtures("all_marks")
    def test_data_are_on_the_disk_before_the_mark(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Whatever has content when the mark is set has been synchronised since it was written."""
        synchronise, replace = files.sync_file, files.replace_file
        synchronised: dict[str, bytes] = {}
        missing: list[Mapping[str, bytes]] = []
        store = store_of(path).name

        def sync_file(file: Path) -> None:
            synchronised[str(file).replace(f".{store}.new", store)] = file.read_bytes()
            synchronise(file)

        def replace_file(file: Path, content: str) -> None:
            chunks = [chunk for chunk in file.parent.rglob("c.*") if chunk.is_file()]
            now = {str(chunk): chunk.read_bytes() for chunk in chunks}
            missing.append({chunk: data for chunk, data in now.items() if synchronised.get(chunk) != data})
            replace(file, content)

        monkeypatch.setattr(zarr_files, "sync_file", sync_file)
        monkeypatch.setattr(zarr_store, "sync_file", sync_file)
        monkeypatch.setattr(zarr_store, "replace_file", replace_file)
        write(path, result(), 10)
        assert len(missing) >= 5
        assert not any(missing)

    @pytest.mark.usefixtures("all_marks")
    @pytest.mark.parametrize("marks_before", mostly_slow(1, [4, 0]))
    def test_disk_full_at_a_mark(
        self, path: Path, is_store: bool, marks_before: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """One line says so, and the run resumes after space is made."""
        replace = files.replace_file
        calls = 0

        def full(file: Path, text: str) -> None:
            nonlocal calls
            calls += 1
            if calls > marks_before:
                raise OSError(errno.ENOSPC, "No space left on device")
            replace(file, text)

        with monkeypatch.context() as patch, refused(path.name, "disk is full"):
            patch.setattr(zarr_store, "replace_file", full)
            write(path, result(), 10)
        assert is_store or not path.exists()
        write(path, result(), 10)
        assert_alone(path, result())

    @pytest.mark.usefixtures("all_marks")
    def test_chunk_cannot_be_written(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        from zarr.storage import LocalStore

        set_item = LocalStore.set

        async def full(self: Any, key: str, value: Any, *rest: Any) -> None:
            if key.startswith("iterations/c.2"):
                raise OSError(errno.ENOSPC, "No space left on device")
            await set_item(self, key, value, *rest)

        with monkeypatch.context() as patch, refused(path.name, "disk is full"):
            patch.setattr(LocalStore, "set", full)
            write(path, result(), 10)
        stored = read_slopes(store_of(path))
        assert (stored.n_finished, stored.complete) == (20, False)
        np.testing.assert_array_equal(stored.variables["iterations"], result()["iterations"][:20])
        write(path, result(), 10)
        assert_alone(path, result())

    def test_damaged_store(self, path: Path) -> None:
        begin(path, 13)
        (store_of(path) / "y" / "c.1.0").write_bytes(b"")
        assert_refused(path, "damaged", "y ")
        shutil.rmtree(store_of(path) / "flux")
        assert_refused(path, "delete", "flux")
        (store_of(path) / "zarr.json").write_text("{")
        assert_refused(path, "damaged data", "delete")

    def test_second_writer_is_refused(self, path: Path) -> None:
        with writer_for(path) as writer:
            writer.append(0, part(result(), 0, 20))
            other_run = {"attributes": OTHER_RUN, "overwrite": True}
            for changes in ({}, other_run, {"overwrite": True}):
                assert_refused(path, path.name, f"is being written by process {os.getpid()}", **changes)
            writer.append(20, part(result(), 20, 50))
        assert_alone(path, result())
