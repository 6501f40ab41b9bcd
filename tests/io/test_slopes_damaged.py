"""Checksums: damage is said in one line, and never read as other slopes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io.slope_files import part, result, write, writer_for

from faintspot.base.errors import InputError
from faintspot.io import read_slopes
from faintspot.io.arrays import zarr_store
from faintspot.io.stored import slopes_folder, slopes_writer, slopes_zarr

fits = pytest.importorskip("astropy.io.fits")
zarr = pytest.importorskip("zarr")


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store of 50 frames, 10 a chunk; in one chunk all flags are 0, as in most."""
    monkeypatch.setattr(slopes_zarr, "_CHUNK_NUMBERS", 70)
    write(tmp_path / "slopes.zarr", whole())
    return tmp_path / "slopes.zarr"


def whole() -> dict[str, Any]:
    slopes = result()
    slopes["flags"][20:30] = 0
    return slopes


def read_or_refuse(path: Path) -> bool:
    """Whether it is refused; else it must be what was written."""
    message = ""
    try:
        stored = read_slopes(path)
    except InputError as error:
        message = str(error)
    if message:
        assert message.startswith(str(path))
        assert "\n" not in message
        return True
    for name, values in result().items():
        np.testing.assert_array_equal(stored.variables[name], values)
    assert stored.attributes["sources"] == ["a.fits", "b.fits"]
    return False


@pytest.mark.parametrize("name", ["slopes.fits", "slopes.fits.gz", "slopes.npz"])
def test_one_wrong_bit_anywhere(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write(path, result())
    content = path.read_bytes()
    generator = np.random.default_rng(5)
    places = generator.integers(0, len(content), 80)
    refused = []
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(generator.integers(8))
        path.write_bytes(damaged)
        refused.append(read_or_refuse(path))
    # What may change unseen is what fills blocks, and time stamps of zip and gzip, which nobody reads.
    assert np.mean(refused) > 0.5


def test_astropy_verifies_the_checksums(tmp_path: Path) -> None:
    write(tmp_path / "slopes.fits", result())
    with fits.open(tmp_path / "slopes.fits", checksum=True) as units:  # a warning is an error
        for unit in units:
            assert unit.verify_checksum() == unit.verify_datasum() == 1


@pytest.mark.parametrize("name", ["x", "flags", "valid", "centre_x"])
@pytest.mark.parametrize("damage", ["lost", "empty", "short", "bit"])
def test_chunk(store: Path, name: str, damage: str) -> None:
    chunk = store / name / ("c.0" if name == "centre_x" else "c.2.0")
    content = bytearray(chunk.read_bytes())
    content[5] ^= 4
    if damage == "lost":
        chunk.unlink()
    else:
        chunk.write_bytes({"empty": bytearray(), "short": content[:9], "bit": content}[damage])
    with pytest.raises(InputError) as error:
        read_slopes(store)
    assert str(error.value).startswith(f"{store}: the store is damaged: {name} ")
    assert "\n" not in str(error.value)


def test_chunk_that_is_damaged_while_a_run_is_interrupted(tmp_path: Path) -> None:
    path = tmp_path / "slopes.zarr"
    with writer_for(path) as writer:
        writer.append(0, part(whole(), 0, 13))
    (path / "y" / "c.0.0").write_bytes(b"")
    with pytest.raises(InputError, match="the store is damaged: y "):
        writer_for(path)


@pytest.mark.parametrize("name", ["slopes.zarr", "slopes.npz"])
def test_data_are_on_the_disk_before_the_mark(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever has content when the mark is set has been synchronised since it was written."""
    monkeypatch.setattr(slopes_zarr, "_CHUNK_NUMBERS", 70)
    monkeypatch.setattr(slopes_writer, "_MARK_SECONDS", 0.0)
    storage, marks = (slopes_zarr, zarr_store) if name.endswith("zarr") else (slopes_folder, slopes_folder)
    synchronise, replace = storage.sync_file, marks.replace_file
    synchronised: dict[str, bytes] = {}
    missing: list[Mapping[str, bytes]] = []

    def sync_file(path: Path) -> None:
        synchronised[str(path).replace(".slopes.zarr.new", "slopes.zarr")] = path.read_bytes()
        synchronise(path)

    def replace_file(path: Path, content: str) -> None:
        files = [file for file in path.parent.rglob("*") if file.is_file() and not file.name.endswith("json")]
        now = {str(file): file.read_bytes() for file in files if file.name != "finished"}
        missing.append({file: data for file, data in now.items() if synchronised.get(file) != data})
        replace(path, content)

    monkeypatch.setattr(storage, "sync_file", sync_file)
    monkeypatch.setattr(marks, "replace_file", replace_file)
    write(tmp_path / name, result(), 10)
    assert len(missing) >= 5
    assert not any(missing)
