"""Telemetry in a Zarr store (format 3) that grows while the engine runs.

Data are appended to the arrays in chunks with checksums (crc32c); then the counters in the group's attributes
are replaced. However the recording ends, the store is valid and the counters count complete data only.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import output_errors
from faintspot.io.arrays.zarr_store import TELEMETRY, checked_codecs, new_store, replace_attributes
from faintspot.io.optional_packages import load_zarr
from faintspot.io.telemetry.recording import ARRAYS, CONTROL, FRAMES, IMAGES, PARTS, stored_names

zarr = load_zarr()
_CHUNK_NUMBERS, _CHUNK_BYTES = 1 << 16, 1 << 22
_WRITTEN_ONCE = PARTS, CONTROL


class TelemetryStore:
    """Writer of telemetry to a new Zarr store.

    Parameters
    ----------
    path : path
        A directory that does not exist yet.
    record_type, image_type : structured dtype
        Types of the items to append; each field becomes an array of the store.
    attributes : mapping
        JSON values.

    Raises
    ------
    InputError
        When the path exists or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        record_type: np.dtype[np.void],
        image_type: np.dtype[np.void],
        attributes: Mapping[str, object],
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise InputError(f"{self.path}: already exists; choose another name")
        self.frames = self.images = 0
        """Numbers of complete frames and images in the store."""
        begin = {"format": TELEMETRY, "version": 1, "changes": [], "complete": False, FRAMES: 0, IMAGES: 0}
        with output_errors(self.path):
            _create(self.path, (record_type, image_type), {**attributes, **begin})
        group: Any = zarr.open_group(str(self.path), mode="r+")
        # Write chunks of zeros, too, so that a missing chunk means lost data.
        with zarr.config.set({"array.write_empty_chunks": True}):
            self._arrays: dict[str, Any] = dict(group.arrays())

    def append(self, records: NDArray[Any], images: NDArray[Any], attributes: Mapping[str, object]) -> None:
        """Append records and images and replace attributes; on return they are in the store.

        Raises
        ------
        InputError
            When the disk is full or not writable; earlier data can still be read.
        """
        with output_errors(self.path):
            for name, values in (*_columns(records), *_columns(images)):
                if not len(values):
                    continue
                array = self._arrays[name]
                start = self.images if ARRAYS[name].dimensions[0] == "image" else self.frames
                array.resize((start + len(values), *values.shape[1:]))
                array[start:] = values
            frames, images_there = self.frames + len(records), self.images + len(images)
            counters = {FRAMES: frames, IMAGES: images_there}
            replace_attributes(self.path, {**attributes, **counters})
        self.frames, self.images = frames, images_there


def _create(path: Path, kinds: tuple[np.dtype[np.void], ...], attributes: Mapping[str, object]) -> None:
    rest = {name: value for name, value in attributes.items() if name not in _WRITTEN_ONCE}
    with new_store(path, rest) as group:
        group.create_group(PARTS, attributes={name: attributes.get(name) for name in _WRITTEN_ONCE})
        for name, values in (column for kind in kinds for column in _columns(np.empty(0, kind))):
            row = values.shape[1:]
            size = int(np.prod(row))
            is_image = ARRAYS[name].dimensions[0] == "image"
            length = _CHUNK_BYTES // (size * values.itemsize) if is_image else _CHUNK_NUMBERS // size
            group.create_array(
                name,
                shape=(0, *row),
                chunks=(max(1, length), *row),
                dtype=values.dtype,
                compressors=checked_codecs(),
                dimension_names=ARRAYS[name].dimensions,
                attributes={"units": ARRAYS[name].units},
            )


def _columns(items: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """Return the stored fields of a structured array, by name."""
    return [(name, items[name]) for name in stored_names(items.dtype)]
