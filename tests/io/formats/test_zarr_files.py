import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io.frame_files import cube, save, zarr
from tests.refusals import refused

from faintspot.io import open_frames, read_array


def test_frames_before_a_damaged_zarr_chunk_are_read(tmp_path: Path) -> None:
    store = save(tmp_path / "v3.zarr", cube())
    chunk = store / "c" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:20])
    with open_frames([store]) as source:
        np.testing.assert_array_equal(source.block(0, 4), cube()[:4])
        with refused("v3.zarr", "frames 4 to 7", "damaged"):
            source.block(4, 8)


def test_missing_chunk_holds_the_fill_value(tmp_path: Path) -> None:
    """By Zarr's definition."""
    zarr.create_array(str(tmp_path / "a.zarr"), shape=(500, 64, 64), chunks=(1, 64, 64), dtype="f4")
    with open_frames([tmp_path / "a.zarr"]) as frames:
        assert frames.block(499, 500).shape == (1, 64, 64)


def test_array_within_groups(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_array(f"{save(tmp_path / 'group.zarr', cube())}:dark"), cube()[0])
    mask = cube()[0] > 0
    zarr.open_group(str(tmp_path / "deep.zarr")).create_array("night/dark", data=mask)
    np.testing.assert_array_equal(read_array(f"{tmp_path / 'deep.zarr'}:night/dark"), mask)


@pytest.mark.parametrize("dtype", ["<f4", "|O"])
@pytest.mark.parametrize(
    "codecs",
    [
        {"filters": [{"id": "pickle"}], "compressor": None},
        {"filters": None, "compressor": {"id": "pickle"}},
        {"filters": [{"id": "shuffle", "elementsize": 4}, {"id": "pickle"}], "compressor": {"id": "zlib"}},
    ],
)
def test_nothing_is_unpickled(tmp_path: Path, codecs: dict[str, Any], dtype: str) -> None:
    """A pickled object may run any code when it is loaded: here it would make a file."""
    path, made = tmp_path / "a.zarr", tmp_path / "made"
    path.mkdir()
    shape = {"zarr_format": 2, "shape": [1, 2, 2], "chunks": [1, 2, 2], "order": "C", "fill_value": 0}
    (path / ".zarray").write_text(json.dumps({**shape, "dtype": dtype, **codecs}))

    class Hostile:
        def __reduce__(self) -> Any:
            return Path.touch, (made,)

    (path / "0.0.0").write_bytes(pickle.dumps(Hostile()))
    with refused("a.zarr"), open_frames([path]) as source:
        source.block(0, 1)
    assert not made.exists()
