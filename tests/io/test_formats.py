"""A format that somebody adds passes the tests of all formats."""

import json
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.io.frame_files import FrameFile
from tests.io.frame_format_tests import FrameFormatTests
from tests.io.slope_files import assert_refused
from tests.io.slope_format_tests import SlopeFormatTests
from tests.refusals import refused

from faintspot.base.flags import VARIABLES
from faintspot.io import frames, open_frames
from faintspot.io.file_format import FileFormat, StoredSlopes
from faintspot.io.fits_units import StreamedArray
from faintspot.io.stored_array import StoredArray


class Plain(FileFormat):
    """A line with type and shape, then the frames; slopes as JSON."""

    name = "plain"
    signatures = (b"PLAIN",)
    endings = (".plain",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        if key is not None:
            raise KeyError(key)
        line = path.read_bytes().split(b"\n", 1)[0]
        dtype, shape = np.dtype(line.split()[1].decode()), tuple(int(side) for side in line.split()[2:])
        return StoredArray(
            str(path),
            shape,
            dtype,
            lambda files: StreamedArray(files.enter_context(path.open("rb")), len(line) + 1, dtype, shape),
        )

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        arrays = {**slopes.variables, **slopes.coordinates}
        lists = {name: values[:].tolist() for name, values in arrays.items()}
        stream.write(json.dumps({**lists, "attributes": slopes.attributes}).encode())

    def read(self, path: Path) -> StoredSlopes:
        content = json.loads(path.read_text())
        attributes = content.pop("attributes")
        variables = {
            name: np.array(content.pop(name), variable.dtype)
            if name in content
            else np.full(np.shape(content["flux"]), variable.if_absent, variable.dtype)
            for name, variable in reversed(list(VARIABLES.items()))
        }
        coordinates = {name: np.array(values) for name, values in content.items()}
        return StoredSlopes(variables, coordinates, attributes, True, len(variables["x"]))


def save(path: Path, frames: NDArray[Any]) -> None:
    shape = " ".join(str(side) for side in frames.shape)
    path.write_bytes(f"PLAIN {frames.dtype.str} {shape}\n".encode() + frames.tobytes())


@pytest.fixture(autouse=True)
def one_more_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames, "FORMATS", (*frames.FORMATS, Plain()))


class TestFrames(FrameFormatTests):
    @pytest.fixture
    def kind(self) -> FrameFile:
        return FrameFile("plain", save)


class TestSlopes(SlopeFormatTests):
    @pytest.fixture
    def name(self) -> str:
        return "slopes.plain"


def test_it_is_listed(tmp_path: Path) -> None:
    (tmp_path / "a.unknown").write_text("text")
    assert_refused(tmp_path / "b.txt", ".csv", ".plain")
    with refused("MATLAB", "plain"):
        open_frames([tmp_path / "a.unknown"])
