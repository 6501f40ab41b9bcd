from __future__ import annotations

import json
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from tests.io.frame_files import cube
from tests.io.slope_files import assert_refused, assert_stored, part, result, write, writer_for

from faintspot.io import open_frames
from faintspot.io.arrays.raw import RawArray
from faintspot.io.formats import registry as formats
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray
from faintspot.io.stored.slopes_format import VARIABLES, StoredSlopes


class Plain(FileFormat):
    """A format of somebody's own: a line that says the shape, then int16; slopes as JSON."""

    name = "plain"
    signatures = (b"PLAIN",)
    endings = (".plain",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        line = path.read_bytes().split(b"\n", 1)[0]
        shape = tuple(int(length) for length in line.split()[1:])
        return RawArray(
            str(path),
            lambda: path.open("rb"),
            offset=len(line) + 1,
            dtype=np.dtype("<i2"),
            shape=shape,
            forward_only=False,
        )

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        whole = {
            name: values.tolist() for name, values in (*slopes.variables.items(), *slopes.coordinates.items())
        }
        stream.write(json.dumps({**whole, "attributes": slopes.attributes}).encode())

    def read(self, path: Path) -> StoredSlopes:
        whole = json.loads(path.read_text())
        attributes = whole.pop("attributes")
        variables = {name: np.array(whole.pop(name), variable.dtype) for name, variable in VARIABLES.items()}
        coordinates = {name: np.array(values) for name, values in whole.items()}
        return StoredSlopes(variables, coordinates, attributes, True, len(variables["x"]))


@pytest.fixture(autouse=True)
def one_more_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "FORMATS", (*formats.FORMATS, Plain()))


def test_frames(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"PLAIN 11 6 8\n" + cube().astype("<i2").tobytes())
    with open_frames([tmp_path / "a"]) as source:
        np.testing.assert_array_equal(source.block(2, 9), cube()[2:9])


def test_slopes_are_written_resumed_and_guarded(tmp_path: Path) -> None:
    path = tmp_path / "a.plain"
    with writer_for(path) as writer:
        writer.append(0, part(result(), 0, 13))
        assert_refused(path, "is being written")
    assert writer_for(path).finished() == 13
    write(path, result())
    assert_stored(path, result())
    with writer_for(path) as writer:
        assert writer.finished() == 50
    assert_refused(path, "another run", n_frames=51)


def test_it_is_listed(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("text")
    assert_refused(tmp_path / "b.txt", ".csv or .plain")
    with pytest.raises(ValueError, match="MATLAB or plain file or a Zarr store"):
        open_frames([tmp_path / "a.txt"])
