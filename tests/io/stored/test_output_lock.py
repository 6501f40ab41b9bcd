import fcntl
import os
import socket
from pathlib import Path

import pytest

from faintspot.base.errors import InputError
from faintspot.io.stored.output_lock import OutputLock


class TestLock:
    def test_one_at_a_time(self, tmp_path: Path) -> None:
        first = OutputLock(tmp_path / "a.npz")
        with pytest.raises(InputError) as error:
            OutputLock(tmp_path / "a.npz")
        owner = f"process {os.getpid()} on {socket.gethostname()}"
        assert f"a.npz: is being written by {owner}; wait" in str(error.value)
        OutputLock(tmp_path / "b.npz").release()
        first.release()
        first.release()
        assert not list(tmp_path.iterdir())
        OutputLock(tmp_path / "a.npz").release()

    def test_file_that_somebody_left(self, tmp_path: Path) -> None:
        (tmp_path / ".a.npz.lock").write_text("process 1 on a machine with a long name that has ended")
        lock = OutputLock(tmp_path / "a.npz")
        assert (tmp_path / ".a.npz.lock").read_text() == f"process {os.getpid()} on {socket.gethostname()}"
        lock.release()

    def test_file_that_its_holder_removes_meanwhile(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """What is locked then is a file that nobody else would find."""
        file = tmp_path / ".a.npz.lock"
        original = fcntl.flock
        removed: list[Path] = []

        def remove_first(descriptor: int, operation: int) -> None:
            original(descriptor, operation)
            if not removed:
                file.unlink()
                removed.append(file)

        monkeypatch.setattr(fcntl, "flock", remove_first)
        lock = OutputLock(tmp_path / "a.npz")
        assert file.exists()
        with pytest.raises(InputError, match="is being written"):
            OutputLock(tmp_path / "a.npz")
        lock.release()
