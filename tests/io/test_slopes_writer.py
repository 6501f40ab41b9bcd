import errno
import fcntl
import os
import socket
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.io.slope_files import assert_stored, part, result, write, writer_for
from tests.refusals import refused

from faintspot.io import slopes_writer
from faintspot.io.formats import zarr_files
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


@pytest.mark.slow
@pytest.mark.parametrize("line", range(14))
def test_ctrl_c_at_any_line_of_the_writer(tmp_path: Path, line: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever line is reached when the signal comes, no frame is stored twice or lost."""
    monkeypatch.setattr(zarr_files, "_CHUNK_NUMBERS", 70)
    monkeypatch.setattr(slopes_writer, "_MARK_SECONDS", 0.0)
    whole, n_lines = result(), -1

    def trace(frame: Any, event: str, _: Any) -> Any:
        nonlocal n_lines
        code = frame.f_code
        if code.co_filename != slopes_writer.__file__ or code.co_name not in ("append", "_store_waiting"):
            return None
        if event != "line":
            return trace
        n_lines += 1
        if n_lines == line + 20:  # in the second block, which fills a chunk
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    def interrupted() -> None:
        with writer_for(tmp_path / "slopes.zarr") as writer:
            sys.settrace(trace)
            for start in range(0, 50, 8):
                writer.append(start, part(whole, start, min(start + 8, 50)))

    before = sys.gettrace()
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
    finally:
        sys.settrace(before)
    write(tmp_path / "slopes.zarr", whole)
    assert_stored(tmp_path / "slopes.zarr", whole)
