"""The segment of a pixel ring: what is not one, or not whole, or not private, is refused in one line."""

import os
from pathlib import Path

import numpy as np
import pytest
from tests import refusals
from tests.engine.commands import needs_shared_memory

from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.segment import FOLDER

pytestmark = needs_shared_memory

SHAPE = (24, 32)


def refused(name: str, *texts: str) -> None:
    """Attach and create refuse in one line each."""
    for action in (PixelRing.attach, lambda which: PixelRing.create(which, SHAPE, np.float32)):
        with refusals.refused(*texts):
            action(name)


@pytest.mark.parametrize("raw", [b"", b"x" * 4096, b"faintspt"])
def test_what_is_not_a_ring_is_refused(name: str, raw: bytes) -> None:
    path = FOLDER / name
    path.write_bytes(raw)
    path.chmod(0o600)
    refused(name, str(path), "expected a pixel ring")
    assert path.read_bytes() == raw


def test_other_kinds_of_files_are_refused(name: str, tmp_path: Path) -> None:
    path = FOLDER / name
    os.mkfifo(path, 0o600)
    refused(name, "expected a pixel ring")
    path.unlink()
    path.symlink_to(tmp_path)
    refused(name, "cannot be opened")
    path.unlink()
    path.mkdir(0o700)
    refused(name, "expected a pixel ring")
    path.rmdir()


def test_rings_that_others_can_open_are_refused(name: str) -> None:
    with PixelRing.create(name, SHAPE, np.float32):
        (FOLDER / name).chmod(0o644)
        refused(name, "only you can open")


@pytest.mark.parametrize(("position", "text"), [(8, "version"), (12, "damaged"), (4100, "damaged")])
def test_damaged_headers_are_refused(name: str, position: int, text: str) -> None:
    with PixelRing.create(name, SHAPE, np.float32):
        raw = bytearray((FOLDER / name).read_bytes())
        raw[position] ^= 4
        (FOLDER / name).write_bytes(raw)
        refused(name, text)


def test_unknown_and_bad_names_are_refused(name: str) -> None:
    with refusals.refused("no such pixel ring"):
        PixelRing.attach(name)
    for bad in ("", "a/b", "../x", ".hidden", "a b", "x" * 201, "a\n"):
        refused(bad, "name = ")


@pytest.mark.parametrize(
    ("shape", "dtype", "slots", "text"),
    [
        ((0, 4), "f4", 4, "shape = 0"),
        ((4, 4, 4), "f4", 4, "shape: expected"),
        ((4, 4), "c8", 4, "dtype = <c8"),
        ((4, 4), "f4", 1, "slots = 1"),
        ((65536, 65536), "f8", 100, "expected at most 64 GiB"),
    ],
)
def test_sizes_that_cannot_be(name: str, shape: tuple[int, int], dtype: str, slots: int, text: str) -> None:
    with refusals.refused(text):
        PixelRing.create(name, shape, dtype, slots=slots)
    assert not (FOLDER / name).exists()


def test_full_shared_memory_is_said(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with refusals.refused(name, "MiB", "No space left"):
        PixelRing.create(name, SHAPE, np.float32)
    assert not [path for path in FOLDER.iterdir() if name in path.name]
