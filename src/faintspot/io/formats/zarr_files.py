"""Zarr stores: frames in format 2 or 3; slopes in format 3, read by xarray even while written.

A chunk of slopes holds a number of frames and is written once, as a whole and with a checksum (crc32c). After
chunks are on the disk, the mark `finished_frames` in the group's attributes is replaced. However the program
ends, the store is valid and the mark counts complete frames only.
"""

import shutil
import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, load_package
from faintspot.base.files import sync_file, sync_folder
from faintspot.base.flags import VARIABLES
from faintspot.io.file_format import (
    COORDINATE_UNITS,
    ExistingOutput,
    FileFormat,
    RecordingHeader,
    StoredSlopes,
    check_stated,
    unit_of,
    with_absent,
)
from faintspot.io.stored_array import StoredArray, choose_name, one_line
from faintspot.io.zarr_store import (
    CheckedChunks,
    check_array,
    checked_codecs,
    chunk_files,
    is_store,
    new_store,
    open_store,
    read_items,
    replace_attributes,
    stored_attributes,
)

_MARK = "finished_frames"
_COMPLETE = "complete"
_COORDINATES = "coordinates"
_AT_ONCE = 16
_CHUNK_NUMBERS = 1 << 16
# As "c.12.0" instead of a folder for each: folders must be synchronised, too.
_CHUNK_NAMES: dict[str, object] = {"name": "default", "separator": "."}


class SlopeStore:
    """Zarr store of the slopes of a run; every method may raise OSError.

    Parameters
    ----------
    path : Path
        Store; created if it does not exist.
    run : RecordingHeader
        Description of its contents.

    Raises
    ------
    InputError
        When it is damaged.
    MissingExtraError
        When zarr is not installed.
    """

    def __init__(self, path: Path, run: RecordingHeader) -> None:
        zarr = load_package("zarr")
        self.path, self._n_frames = path, run.n_frames
        self._not_synchronised: set[Path] = set()
        if not path.exists():
            _create(path, run)
        for leftover in path.glob(".*.new"):  # of an interrupted replacement of the mark
            leftover.unlink()
        group: Any = zarr.open_group(str(path), mode="r+", use_consolidated=False)
        try:
            # Write chunks of zeros, too, so that a missing chunk means lost data.
            with zarr.config.set({"array.write_empty_chunks": True}):
                self._arrays = {name: group[name] for name in VARIABLES}
        except (KeyError, ValueError) as error:
            raise InputError(f"{path}: damaged, cannot be resumed; delete it ({one_line(error)})") from None
        self.chunk = int(self._arrays["x"].chunks[0])
        """Number of frames in a chunk."""

        self.marked: int = _stored_attributes(path)[_MARK]
        """Number of frames that the store states to be complete."""

    def resume(self) -> tuple[int, list[dict[str, NDArray[Any]]]]:
        """Return the number of frames to keep, and those of an incomplete chunk, to be written again."""
        n_stored = self.marked
        start = n_stored if n_stored == self._n_frames else n_stored - n_stored % self.chunk
        if start == n_stored:
            return n_stored, []
        incomplete_chunk = {
            name: read_items(self.path, array, start, n_stored) for name, array in self._arrays.items()
        }
        return start, [incomplete_chunk]

    def mark(self, finished: int) -> None:
        """Wait for the disk, then write the number of complete frames."""
        with ThreadPoolExecutor(_AT_ONCE) as threads:  # several times faster than one after another
            list(threads.map(sync_file, self._not_synchronised))
        for folder in {file.parent for file in self._not_synchronised}:
            sync_folder(folder)
        self._not_synchronised.clear()
        replace_attributes(self.path, {_MARK: finished, _COMPLETE: finished == self._n_frames})
        self.marked = finished

    def write(self, start: int, variables: Mapping[str, NDArray[np.generic]]) -> None:
        """Store whole chunks; the caller marks one that was incomplete as soon as it is written."""
        if self.marked > start:
            self.mark(start)
        for name, values in variables.items():
            array = self._arrays[name]
            array[start : start + len(values)] = values
            self._not_synchronised.update(chunk_files(self.path, array, start, start + len(values)))

    def variables(self) -> Any:
        """Return the variables, each read in parts from the store."""
        return {name: _StoredVariable(self.path, array) for name, array in self._arrays.items()}


class _StoredVariable:
    """A variable of a store; slices of it are arrays."""

    def __init__(self, path: Path, array: Any) -> None:
        self._path, self._array = path, array
        self.shape: tuple[int, ...] = array.shape
        self.dtype: np.dtype[Any] = array.dtype

    def __getitem__(self, part: slice) -> NDArray[Any]:
        start, stop, _ = part.indices(self.shape[0])
        return read_items(self._path, self._array, start, stop)


def remove_store(path: Path) -> None:
    """Move a store away in one step, then delete it."""
    aside = path.with_name(f".{path.name}.old")
    shutil.rmtree(aside, ignore_errors=True)
    path.rename(aside)
    shutil.rmtree(aside)


def describe_store(path: Path) -> ExistingOutput | None:
    """Return the description of a store of slopes; None if the path does not exist.

    Raises
    ------
    InputError
        When the path is something else.
    """
    if not path.exists():
        return None
    try:
        attributes = _stored_attributes(path)
    except (OSError, ValueError, KeyError):
        raise InputError(
            f"{path}: expected slopes or nothing, found other or damaged data; "
            "choose another name or delete it"
        ) from None
    sizes = (attributes["n_frames"], attributes["n_subapertures"])
    return ExistingOutput(attributes["fingerprint"], sizes, attributes[_COMPLETE])


def _create(path: Path, run: RecordingHeader) -> None:
    attributes = {
        **run.attributes,
        "n_frames": run.n_frames,
        "n_subapertures": run.n_subapertures,
        _MARK: 0,
        _COMPLETE: False,
        _COORDINATES: " ".join(run.coordinates),
    }
    chunk = min(run.n_frames, max(1, _CHUNK_NUMBERS // run.n_subapertures))
    with new_store(path, attributes) as group:
        for name, variable in VARIABLES.items():
            group.create_array(
                name,
                shape=(run.n_frames, run.n_subapertures),
                chunks=(chunk, run.n_subapertures),
                dtype=variable.dtype,
                compressors=checked_codecs(),
                chunk_key_encoding=_CHUNK_NAMES,
                fill_value=np.nan if variable.dtype == "float32" else 0,
                dimension_names=("frame", "subaperture"),
                attributes={"units": unit_of(name, run.attributes), "long_name": variable.long_name},
            )
        for name, values in run.coordinates.items():
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                compressors=checked_codecs(),
                chunk_key_encoding=_CHUNK_NAMES,
                dimension_names=("subaperture",),
                attributes={"units": COORDINATE_UNITS[name]} if name in COORDINATE_UNITS else {},
                config={"write_empty_chunks": True},
            )
            array[:] = values
        with warnings.catch_warnings():
            # Consolidated metadata are not yet in the standard of Zarr; xarray warns when they are missing.
            warnings.simplefilter("ignore")
            load_package("zarr").consolidate_metadata(group.store)


def _stored_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store of slopes; raise KeyError if it is something else."""
    attributes = stored_attributes(path)
    for name in (_MARK, _COMPLETE, "fingerprint", "n_frames", "n_subapertures"):
        attributes[name]
    return attributes


class Zarr(FileFormat):
    """Frames in an array of a store; slopes in a store that can be read while it is written."""

    name = "Zarr"
    endings = (".zarr",)

    def has_frames(self, path: Path, start: bytes) -> bool:
        """Return whether the path is a folder."""
        return not start

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the array at path `key`, the store itself, its array `frames`, or its only array.

        By Zarr's definition, missing chunks hold the fill value; that is not an error.
        """
        if not is_store(path):
            raise InputError(f"{path}: expected a Zarr store or a file of frames, this directory is neither")
        zarr = load_package("zarr")
        node: Any = open_store(path, key or "")
        if isinstance(node, zarr.Group):
            arrays = dict(node.arrays())
            node = arrays[choose_name(path, {name: array.shape for name, array in arrays.items()}, None)]
        name = f"{path}:{node.path}" if node.path else str(path)
        options: dict[str, Any] = {"chunks": node.chunks, "compressions": check_array(name, node)}
        chunks = CheckedChunks(name, path / node.path, node)
        return StoredArray(name, node.shape, np.dtype(node.dtype), lambda _: chunks, **options)

    def require(self) -> None:
        """Raise MissingExtraError when zarr is not installed."""
        load_package("zarr")

    def read(self, path: Path) -> StoredSlopes:
        """Read the finished frames of a store; refuse damaged or missing chunks."""
        if not is_store(path):
            raise InputError(f"{path}: expected a Zarr store of slopes, got another directory")
        attributes = _stored_attributes(path)
        finished, complete = int(attributes.pop(_MARK)), bool(attributes.pop(_COMPLETE))
        coordinates = attributes.pop(_COORDINATES, "").split()
        for size in ("n_frames", "n_subapertures"):
            del attributes[size]
        group: Any = open_store(path)
        stored = [name for name in (*VARIABLES, *coordinates) if name in group]
        check_stated(path, {name: group[name].shape for name in stored}, finished)
        return StoredSlopes(
            variables=with_absent(
                {name: read_items(path, group[name], 0, finished) for name in VARIABLES if name in group}
            ),
            coordinates={
                name: read_items(path, group[name], 0, group[name].shape[0]) for name in coordinates
            },
            attributes=attributes,
            complete=complete,
            n_finished=finished,
        )

    def has_slopes(self, path: Path) -> bool:
        """Return whether the store's attributes are those of slopes."""
        try:
            return describe_store(path) is not None
        except InputError:
            return False

    def finished(self, path: Path) -> ExistingOutput | None:
        """Return the description of a complete store."""
        store = describe_store(path)
        return store if store is not None and store.complete else None

    def store(self, path: Path) -> Path:
        """Return the output itself, which grows."""
        return path
