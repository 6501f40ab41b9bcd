from __future__ import annotations

import json
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io.frame_files import FORMATS, assert_message, cube, save
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.io import open_frames


class TestDamageInAStream:
    @pytest.mark.parametrize(("kept", "lost_frame"), [(0.5, None), (1.0, 19)])
    def test_truncated_gzip_keeps_what_came_before(
        self, tmp_path: Path, kept: float, lost_frame: int | None
    ) -> None:
        frames = cube(20, 40, 40)
        path = save(tmp_path / "a.fits.gz", frames)
        content = path.read_bytes()
        path.write_bytes(content[: int(len(content) * kept) - 4])
        with open_frames([path]) as source:
            np.testing.assert_array_equal(source.block(0, 5), frames[:5])
            with pytest.raises(InputError) as error:
                source.block(5, 20)
            assert_message(error, "a.fits.gz: frame", "damaged or incomplete")
            if lost_frame is not None:
                assert_message(error, f"frame {lost_frame} ")
            else:
                lost = int(re.search(r"frame (\d+)", str(error.value)).group(1))  # type: ignore[union-attr]
                assert 5 < lost < 19
                np.testing.assert_array_equal(source.block(5, lost), frames[5:lost])

    def test_wrong_checksum_of_gzip_and_zip(self, tmp_path: Path) -> None:
        packed = save(tmp_path / "a.fits.gz", cube(11, 60, 80))
        content = bytearray(packed.read_bytes())
        content[-8] ^= 1
        packed.write_bytes(content)
        stored = save(tmp_path / "a.npz", cube(11, 60, 80))
        content = bytearray(stored.read_bytes())
        content[50_000] ^= 1  # within the uncompressed pixels
        stored.write_bytes(content)
        for path in (packed, stored):
            with open_frames([path]) as source:
                source.block(0, 10)
                with refused(path.name, "frame 10 ", "damaged", "CRC"):
                    source.block(10, 11)

    def test_file_cut_while_it_is_read(self, tmp_path: Path) -> None:
        path = save(tmp_path / "a.npy", cube())
        with open_frames([path]) as source:
            path.write_bytes(path.read_bytes()[: 128 + 4 * 96 + 10])
            with pytest.raises(InputError) as error:
                source.block(0, 11)
        assert_message(error, "frame 4 ", "end too early")

    def test_zip_and_store(self, tmp_path: Path) -> None:
        path = save(tmp_path / "a.deflated.npz", cube())
        path.write_bytes(path.read_bytes()[:-100])
        with refused("a.deflated.npz", ".npz"):
            open_frames([path])
        store = save(tmp_path / "v3.zarr", cube())
        chunk = store / "c" / "1" / "0" / "0"
        chunk.write_bytes(chunk.read_bytes()[:20])
        with open_frames([store]) as source:
            source.block(0, 4)
            with pytest.raises(InputError) as error:
                source.block(4, 8)
        assert_message(error, "v3.zarr", "frames 4 to 7", "damaged")
        (store / "zarr.json").write_text("{")
        with refused("v3.zarr"):
            open_frames([store])


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.endswith("zarr")])
def test_any_damage_is_one_line_or_harmless(tmp_path: Path, name: str) -> None:
    """Cut short or with wrong bytes, mostly in the header: frames come out or InputError, nothing else."""
    path = save(tmp_path / f"a.{name}", cube())
    content = path.read_bytes()
    generator = np.random.default_rng(1)
    messages = []
    for attempt in range(40):
        damaged = bytearray(content)
        if attempt % 3 == 0:
            damaged = damaged[: generator.integers(len(damaged))]
        else:
            for position in generator.integers(min(len(damaged), 400 * (attempt % 3)), size=3):
                damaged[position] = generator.integers(256)
        path.write_bytes(damaged)
        try:
            with open_frames([path]) as source:
                source.block(0, min(source.n_frames, 11))
        except InputError as error:
            messages.append(str(error))
    assert messages
    for message in messages:
        assert "\n" not in message
        assert path.name in message


@pytest.mark.parametrize("dtype", ["<f4", "|O"])
@pytest.mark.parametrize(
    "codecs",
    [
        {"filters": [{"id": "pickle"}], "compressor": None},
        {"filters": None, "compressor": {"id": "pickle"}},
        {"filters": [{"id": "shuffle", "elementsize": 4}, {"id": "pickle"}], "compressor": {"id": "zlib"}},
    ],
)
def test_nothing_in_a_store_is_unpickled(tmp_path: Path, codecs: dict[str, Any], dtype: str) -> None:
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
