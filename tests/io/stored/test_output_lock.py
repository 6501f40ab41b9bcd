from __future__ import annotations

import errno
import fcntl
import os
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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

from faintspot.base.errors import InputError
from faintspot.io import read_slopes
from faintspot.io.stored import slopes_zarr
from faintspot.io.stored.output_lock import OutputLock

pytest.importorskip("astropy")
pytest.importorskip("zarr")
OTHER: dict[str, Any] = {"attributes": {**ATTRIBUTES, "fingerprint": "other"}, "overwrite": True}


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


@pytest.mark.parametrize("name", NAMES)
class TestTwoWriters:
    def test_second_is_refused(self, tmp_path: Path, name: str) -> None:
        path, whole = tmp_path / name, result()
        with writer_for(path) as writer:
            writer.append(0, part(whole, 0, 20))
            for how in ({}, OTHER, {"overwrite": True, "resume": False}):
                assert_refused(path, name, f"is being written by process {os.getpid()}", **how)
            writer.append(20, part(whole, 20, 50))
        assert_stored(path, whole)
        assert [entry.name for entry in tmp_path.iterdir()] == [name]

    def test_where_there_are_no_locks_the_first_one_ends(
        self, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(*_: Any) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(fcntl, "flock", refuse)
        monkeypatch.setattr(slopes_zarr, "_CHUNK_NUMBERS", 70)
        path, mine = tmp_path / name, {**result(), "x": result()["y"]}
        first = writer_for(path)
        first.append(0, part(result(), 0, 20))
        second = writer_for(path, **OTHER)
        second.append(0, part(mine, 0, 30))
        with pytest.raises(InputError, match=r"slopes.*another program has replaced"):
            first.append(20, part(result(), 20, 30))
        with pytest.raises(InputError, match="another program has replaced"):
            first.append(20, part(result(), 20, 50))
        first.close()
        second.append(30, part(mine, 30, 50))
        second.close()
        found = read_slopes(path)
        for variable, values in mine.items():
            np.testing.assert_array_equal(found.variables[variable], values)
        assert found.attributes.get("fingerprint", "other") == "other"

    def test_closed_writer_takes_no_more(self, tmp_path: Path, name: str) -> None:
        writer = writer_for(tmp_path / name)
        writer.append(0, part(result(), 0, 20))
        writer.close()
        with pytest.raises(InputError, match=r"expected no more slopes after close\(\), got frame 20"):
            writer.append(20, part(result(), 20, 30))
        write(tmp_path / name, result())
        assert_stored(tmp_path / name, result())
