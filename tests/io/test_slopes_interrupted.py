from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io.slope_files import NAMES, assert_stored, part, result, write, writer_for
from tests.shared_data import ROOT

import faintspot
from faintspot.base.errors import InputError
from faintspot.io import read_slopes
from faintspot.io.arrays import zarr_store
from faintspot.io.stored import slopes_folder, slopes_writer, slopes_zarr

pytest.importorskip("astropy")
pytest.importorskip("zarr")

pytestmark = pytest.mark.machine_time("starts and kills other processes")


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten frames of seven sub-apertures a chunk, and a mark after each."""
    monkeypatch.setattr(slopes_zarr, "_CHUNK_NUMBERS", 70)
    monkeypatch.setattr(slopes_writer, "_MARK_SECONDS", 0.0)


class TestDiskFull:
    """A disk that is full at any one write: one line says so, and the run goes on after space is made."""

    @pytest.mark.usefixtures("small_chunks")
    @pytest.mark.parametrize("name", NAMES)
    @pytest.mark.parametrize("writes_before", [0, 1, 4])
    def test_counter_cannot_be_written(
        self, tmp_path: Path, name: str, writes_before: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        whole = result()
        module = zarr_store if name.endswith(".zarr") else slopes_folder
        original = module.replace_file
        calls = 0

        def full(path: Path, text: str) -> None:
            nonlocal calls
            calls += 1
            if calls > writes_before:
                raise OSError(errno.ENOSPC, "No space left on device")
            original(path, text)

        with monkeypatch.context() as patch:
            patch.setattr(module, "replace_file", full)
            with pytest.raises(InputError) as error:
                write(tmp_path / name, whole, 10)
        assert name in str(error.value)
        assert "disk is full" in str(error.value)
        assert name.endswith(".zarr") or not (tmp_path / name).exists()
        write(tmp_path / name, whole, 10)
        assert_stored(tmp_path / name, whole)

    @pytest.mark.parametrize("name", NAMES[1:])
    def test_file_cannot_be_made(self, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        whole = result()

        synchronise = os.fsync

        def full(descriptor: int) -> None:
            if Path(f"/proc/self/fd/{descriptor}").resolve().name == "output":
                raise OSError(errno.ENOSPC, "No space left on device")
            synchronise(descriptor)

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            with pytest.raises(InputError, match="disk is full"):
                write(tmp_path / name, whole)
        assert not (tmp_path / name).exists()
        assert writer_for(tmp_path / name).finished() == 50
        write(tmp_path / name, whole)
        assert_stored(tmp_path / name, whole)

    def test_real_full_device(self, tmp_path: Path) -> None:
        if not Path("/dev/full").exists():
            pytest.skip("needs /dev/full")
        writer = writer_for(tmp_path / "slopes.npz")
        variable = tmp_path / ".slopes.npz.partial" / "flux"
        variable.unlink()
        variable.symlink_to("/dev/full")
        with pytest.raises(InputError, match=r"slopes\.npz.*disk is full"):
            writer.append(0, part(result(), 0, 8))
        assert writer.finished() == 0

    def test_chunk_cannot_be_written(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        from zarr.storage import LocalStore

        monkeypatch.setattr(slopes_zarr, "_CHUNK_NUMBERS", 70)
        whole = result()
        original = LocalStore.set

        async def full(self: Any, key: str, value: Any, *rest: Any) -> None:
            if key.startswith("iterations/c.2"):
                raise OSError(errno.ENOSPC, "No space left on device")
            await original(self, key, value, *rest)

        with monkeypatch.context() as patch:
            patch.setattr(LocalStore, "set", full)
            with pytest.raises(InputError, match=r"slopes\.zarr.*disk is full"):
                write(tmp_path / "slopes.zarr", whole, 10)
        stored = read_slopes(tmp_path / "slopes.zarr")
        assert (stored.n_finished, stored.complete) == (20, False)
        np.testing.assert_array_equal(stored.variables["iterations"], whole["iterations"][:20])
        write(tmp_path / "slopes.zarr", whole, 10)
        assert_stored(tmp_path / "slopes.zarr", whole)


KILLED = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from faintspot.io import slopes_zarr
from tests.io import slope_files as t
slopes_zarr._CHUNK_NUMBERS = 70
whole = t.result(4000)
print("ready", flush=True)
t.write(Path(sys.argv[1]), whole, 3)
"""


@pytest.mark.parametrize("name", ["slopes.zarr", "slopes.npz"])
def test_killed_again_and_again(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    whole = result(4000)
    package = Path(faintspot.__file__).parents[1]
    seen = [0]
    for attempt in range(2):
        arguments = [sys.executable, "-c", KILLED, str(path), str(package), str(ROOT)]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(0.05 + 0.07 * attempt)
            process.send_signal(signal.SIGKILL)
        place = path if path.exists() else path.with_name(f".{name}.partial")
        if not place.exists() or not any(place.glob("*.json")):
            continue  # killed before the output was begun
        stored = read_slopes(place)
        for variable, array in stored.variables.items():
            np.testing.assert_array_equal(array, whole[variable][: stored.n_finished])
        seen.append(stored.n_finished)
    assert seen == sorted(seen)
    write(path, whole, 100)
    assert_stored(path, whole)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("line", range(14))
def test_ctrl_c_at_any_line_of_the_writer(tmp_path: Path, line: int) -> None:
    """Whichever line is reached when the signal comes, no frame is stored twice or lost."""
    whole, seen = result(), -1
    own = slopes_writer.__file__

    def trace(frame: Any, event: str, _: Any) -> Any:
        nonlocal seen
        if frame.f_code.co_filename != own or frame.f_code.co_name not in ("append", "_store"):
            return None
        if event == "line" and (seen := seen + 1) == line + 20:  # in the second block, which fills a chunk
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
