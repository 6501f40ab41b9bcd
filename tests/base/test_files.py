import errno
import os
from pathlib import Path
from typing import BinaryIO

import pytest

from faintspot.base import files
from faintspot.base.errors import InputError


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


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("night.toml", "night.psf.npz"),
        ("night.1.toml", "night.1.psf.npz"),
        ("night.1", "night.1.psf.npz"),  # not that of night.2
        ("night.1.fits.gz", "night.1.psf.npz"),
        ("night.control.NPZ", "night.control.psf.npz"),
    ],
)
def test_names_of_derived_files(name: str, expected: str) -> None:
    assert files.derived(f"a.b/{name}", ".psf.npz") == Path("a.b") / expected


def test_derived_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "night.zarr").mkdir()
    monkeypatch.chdir(tmp_path / "night.zarr")
    assert files.derived(".", ".csv") == tmp_path / "night.csv"
    with pytest.raises(InputError, match="expected the name of a file"):
        files.derived("/", ".csv")


def test_only_regular_files_of_a_known_size_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "file").write_bytes(bytes(10))
    for name, words in (("pipe", "a named pipe"), ("zero", "a device"), ("file", "at most 9")):
        with pytest.raises(InputError, match=words):
            files.read_bytes(tmp_path / name, "a file", 9)
    assert files.read_bytes(tmp_path / "file", "a file", 10) == bytes(10)
    with pytest.raises(IsADirectoryError):
        files.read_bytes(tmp_path, "a file", 9)


def test_content_is_on_the_disk_before_the_name_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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

    def test_full_disk(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match=r"a\.txt: cannot be written: the disk is full"):
            files.write_atomically(tmp_path / "a.txt", "text")
        assert not list(tmp_path.iterdir())

    def test_folder_that_is_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"b/a: cannot be written: the folder .*/b does not exist"):
            files.write_atomically(tmp_path / "b" / "a", b"")

    def test_folder_in_the_way(self, tmp_path: Path) -> None:
        (tmp_path / "a").mkdir()
        with pytest.raises(InputError, match=r"a: cannot be written: Is a directory: choose another name"):
            files.write_atomically(tmp_path / "a", b"")
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
