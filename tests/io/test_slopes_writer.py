import errno
import fcntl
import os
import socket
from pathlib import Path
from typing import Any

import pytest
from tests.refusals import refused

from faintspot.io.slopes_writer import OutputLock

pytest.importorskip("filelock")


@pytest.mark.parametrize("has_locks", [True, False])
def test_one_writer_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_locks: bool) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    if not has_locks:
        monkeypatch.setattr(fcntl, "flock", refuse)
    first = OutputLock(tmp_path / "a.npz")
    with refused("a.npz: is being written by process", f"{os.getpid()} on {socket.gethostname()}; wait"):
        OutputLock(tmp_path / "a.npz")
    OutputLock(tmp_path / "b.npz").release()
    first.release()
    first.release()
    assert not list(tmp_path.iterdir())
    OutputLock(tmp_path / "a.npz").release()


@pytest.mark.parametrize("content", ["", "1\na machine with a long name that has ended"])
def test_file_that_somebody_left_is_no_lock(tmp_path: Path, content: str) -> None:
    (tmp_path / ".a.npz.lock").write_text(content)
    OutputLock(tmp_path / "a.npz").release()
    assert not list(tmp_path.iterdir())


def test_file_that_its_holder_removes_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is locked then is a file that nobody else would find."""
    file = tmp_path / ".a.npz.lock"
    original, removed = fcntl.flock, list[Path]()

    def remove_first(descriptor: int, operation: int) -> None:
        original(descriptor, operation)
        if not removed and file.exists():
            file.unlink()
            removed.append(file)

    monkeypatch.setattr(fcntl, "flock", remove_first)
    lock = OutputLock(tmp_path / "a.npz")
    assert file.exists()
    with refused("is being written"):
        OutputLock(tmp_path / "a.npz")
    lock.release()
