"""Other users, and what was left behind, cannot hold up a publisher or have files made elsewhere."""

import ctypes.util
import errno
import fcntl
import os
import platform
import stat
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from tests import refusals
from tests.engine.commands import start

from faintspot.base.errors import InputError
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.streams import shared_streams
from faintspot.engine.streams.shared_streams import create_stream, lock_file, pyshmem_module
from faintspot.engine.streams.slope_streams import SlopeStreams

pyshmem = pytest.importorskip("pyshmem")
pytestmark = pytest.mark.slow
STRANGER = 65534
only_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can make another user's files")


@pytest.fixture
def name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """A stream's name; locks are where pyshmem has them by default, in this test's temporary directory."""
    monkeypatch.delenv("PYSHMEM_LOCK_DIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(shared_streams, "LOCK_LIMIT_S", 0.05)
    name = f"fs_test_{uuid4().hex[:12]}"
    yield name
    for part in segments(name):
        part.unlink(missing_ok=True)


def segments(name: str) -> list[Path]:
    base = shared_streams._base(name)
    return [FOLDER / f"{base}{part}" for part in ("", "_meta", "_gpu")]


def refused(name: str) -> str:
    with pytest.raises(InputError) as caught:
        create_stream(name, (4,))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_lock_folder_is_private(name: str, tmp_path: Path) -> None:
    folder = tmp_path / f"pyshmem-locks-{os.getuid()}"
    stream = create_stream(name, (4,))
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert [part.exists() for part in segments(name)] == [True, True, False]
    stream.unlink()
    assert [part.exists() for part in segments(name)] == [False] * 3
    folder.chmod(0o755)  # as pyshmem makes it
    lock_file(name)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@only_root
def test_a_strangers_lock_folder(name: str, tmp_path: Path) -> None:
    folder = tmp_path / f"pyshmem-locks-{os.getuid()}"
    folder.mkdir(0o777)
    os.chown(folder, STRANGER, STRANGER)
    said = refused(name)
    assert str(folder) in said
    assert "set PYSHMEM_LOCK_DIR" in said


def test_a_folder_that_was_chosen_is_not_changed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "locks"
    folder.mkdir(0o755)
    monkeypatch.setenv("PYSHMEM_LOCK_DIR", str(folder))
    with refusals.refused(f"{folder}", "0700"):
        create_stream(name, (4,))
    folder.chmod(0o700)
    create_stream(name, (4,)).unlink()


def test_symbolic_links_are_not_followed(name: str, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    path = lock_file(name)
    path.symlink_to(victim)
    assert f"{path}: expected a lock file or nothing" in refused(name)
    path.unlink()
    path.parent.rename(tmp_path / "elsewhere")
    path.parent.symlink_to(tmp_path / "elsewhere")
    assert str(path.parent) in refused(name)
    assert not victim.exists()


def test_a_lock_that_is_held_is_not_waited_for(name: str) -> None:
    path = lock_file(name)
    with path.open("wb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert f"a living process publishes under this name (it holds {path})" in refused(name)
    create_stream(name, (4,)).unlink()


def test_publishing_does_not_wait_for_a_lock_for_ever(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("faintspot.engine.streams.shared_streams.LOCK_LIMIT_S", 0.05)
    streams = SlopeStreams(name, 3)
    path = lock_file(f"{name}_details")
    with path.open("wb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with refusals.refused("_details", f"{path}"), streams.held():
            pass
    with streams.held():
        pass
    streams.close()


@pytest.mark.parametrize("part", [0, 1, 2])
def test_another_users_stream_is_refused_and_what_is_damaged_replaced(name: str, part: int) -> None:
    path = segments(name)[part]
    path.write_bytes(b"x" * 5000)
    if os.geteuid() == 0:
        os.chown(path, STRANGER, STRANGER)
        assert f"{path} belongs to another user" in refused(name)
        os.chown(path, 0, 0)
    create_stream(name, (4,)).unlink()


MAKER = """
import os, sys, pyshmem
pyshmem.create(sys.argv[1], shape=(4,))
print("made", flush=True)
sys.stdin.read()
os._exit(0)
"""


def maker(name: str) -> Any:
    environment = {**os.environ, "PYSHMEM_LOCK_DIR": str(lock_file(name).parent)}
    process = start(MAKER, name, stdin=subprocess.PIPE, env=environment)
    assert process.stdout is not None
    assert process.stdout.readline() == "made\n"
    return process


def test_a_living_maker_and_a_dead_one(name: str) -> None:
    with maker(name) as process:
        assert f"a living process publishes under this name (pid {process.pid})" in refused(name)
    create_stream(name, (4,)).unlink()


def test_another_process_with_the_makers_number_is_not_the_maker(name: str) -> None:
    """As after a container's restart, when all have the same numbers again: this one is younger."""
    with maker(name) as process:
        long_ago = time.time() - 3600
        for path in segments(name)[:2]:
            os.utime(path, (long_ago, long_ago))
        create_stream(name, (4,)).unlink()
        assert process.poll() is None


def test_no_room_is_one_line(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, offset: int, length: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = set(FOLDER.iterdir())
    monkeypatch.setattr(os, "posix_fallocate", full)
    assert "bytes exceed the free space in /dev/shm" in refused(name)
    assert set(FOLDER.iterdir()) == before


def test_pyshmem_needs_libatomic_on_other_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it its readers wait for the lock, which an engine holds for good."""
    monkeypatch.setattr(shared_streams, "_keeps_order", shared_streams._keeps_order.__wrapped__)
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    assert pyshmem_module("publishing") is pyshmem
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    with refusals.refused("libatomic", "aarch64"):
        pyshmem_module("publishing")
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: "libatomic.so.1")
    assert pyshmem_module("publishing") is pyshmem


def test_of_three_streams_all_or_none(name: str) -> None:
    with maker(f"{name}_marks"):
        with refusals.refused("_marks"):
            SlopeStreams(name, 3)
        assert not segments(f"{name}_slopes")[0].exists()
    SlopeStreams(name, 3).close()
