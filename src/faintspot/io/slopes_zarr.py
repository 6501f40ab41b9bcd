"""Slopes to a Zarr store (format 3) that xarray reads, also while it is being written.

A chunk holds a number of frames and is written once, whole; then the counter `finished_frames` in the
group's attributes is replaced. However the program ends, the store is valid and the counter includes only
what is whole.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.files import output_errors, replace_file
from faintspot.io.locations import one_line
from faintspot.io.slopes_format import (
    COORDINATE_UNITS,
    VARIABLES,
    Run,
    StoredSlopes,
    belongs_to_another_run,
    checked_block,
    exists_already,
    with_absent,
)
from faintspot.io.zarr_files import is_store, zarr

_COUNTER = "finished_frames"
_COMPLETE = "complete"
_COORDINATES = "coordinates"
_CHUNK_NUMBERS = 1 << 16


class ZarrWriter:
    """Writes slopes to a Zarr store, resuming the one that is there (see `prepare_store`).

    Frames of a chunk that is not full wait in memory until it is, or until `close`.
    """

    def __init__(self, path: Path, run: Run) -> None:
        self._path = path
        self._run = run
        with output_errors(path):
            if not path.exists():
                _create_store(path, run)
        group: Any = zarr.open_group(str(path), mode="r+")
        try:
            self._arrays: dict[str, Any] = {name: group[name] for name in VARIABLES}
        except (KeyError, ValueError) as error:
            raise InputError(
                f"{path}: damaged, it cannot be resumed: delete it ({one_line(error)})"
            ) from None
        self._chunk = int(self._arrays["x"].chunks[0])
        self._stored = int(group.attrs[_COUNTER])
        self._waiting: list[dict[str, NDArray[Any]]] = []
        if self._stored < run.n_frames and self._stored % self._chunk:
            self._take_back_last_chunk()

    def finished(self) -> int:
        """Return how many frames it has, stored or waiting: the next block starts there."""
        return self._stored + sum(len(block["x"]) for block in self._waiting)

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Add a block of frames; whole chunks go to the disk."""
        arrays = checked_block(self._run, self.finished(), start, block)
        self._waiting.append({name: array.copy() for name, array in arrays.items()})
        waiting = self.finished() - self._stored
        if waiting >= self._chunk:
            self._store(waiting - waiting % self._chunk)
        if self.finished() == self._run.n_frames:
            self.close()

    def close(self) -> None:
        """Store what waits, and mark the store complete when it has all frames."""
        waiting = self.finished() - self._stored
        if waiting:
            self._store(waiting)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _store(self, count: int) -> None:
        """Write the first `count` waiting frames, then the counter."""
        joined = {name: np.concatenate([block[name] for block in self._waiting]) for name in VARIABLES}
        finished = self._stored + count
        with output_errors(self._path):
            for name, array in self._arrays.items():
                array[self._stored : finished] = joined[name][:count]
            self._write_counter(finished)
        self._stored = finished
        rest = {name: array[count:] for name, array in joined.items()}
        self._waiting = [rest] if len(rest["x"]) else []

    def _take_back_last_chunk(self) -> None:
        """Take frames of a chunk that is not full back into memory, so that it is written again whole."""
        start = self._stored - self._stored % self._chunk
        self._waiting = [{name: array[start : self._stored] for name, array in self._arrays.items()}]
        with output_errors(self._path):
            self._write_counter(start)
        self._stored = start

    def _write_counter(self, finished: int) -> None:
        counters = {_COUNTER: finished, _COMPLETE: finished == self._run.n_frames}
        _replace_attributes(self._path, counters)


def prepare_store(path: Path, run: Run, *, resume: bool, overwrite: bool) -> None:
    """Keep a store at `path` when it is this run's; move it away or refuse when it is not.

    With `overwrite` a finished store, or one of another run, is deleted at once, before the new one is begun.

    Raises
    ------
    InputError
        When the path is taken by something else than slopes, or by slopes that must not be touched.
    """
    if not path.exists():
        return
    try:
        attributes = _stored_attributes(path)
    except (OSError, ValueError, KeyError):
        raise InputError(f"{path}: exists and holds no slopes of faintspot: choose another name") from None
    sizes = (attributes["n_frames"], attributes["n_subapertures"])
    equal = attributes["fingerprint"] == run.fingerprint and sizes == run.sizes
    if equal and resume and not (overwrite and attributes[_COMPLETE]):
        return
    if not overwrite:
        raise exists_already(path) if equal else belongs_to_another_run(path)
    with output_errors(path):
        aside = path.with_name(f".{path.name}.old")
        shutil.rmtree(aside, ignore_errors=True)
        path.rename(aside)
        shutil.rmtree(aside)


def read_store(path: Path) -> StoredSlopes:
    """Read the finished frames of a Zarr store of slopes."""
    if not is_store(path):
        raise InputError(f"{path}: expected slopes, this directory is not a Zarr store")
    attributes = _stored_attributes(path)
    finished, complete = int(attributes.pop(_COUNTER)), bool(attributes.pop(_COMPLETE))
    coordinates = attributes.pop(_COORDINATES, "").split()
    for size in ("n_frames", "n_subapertures"):
        del attributes[size]
    group: Any = zarr.open_group(str(path), mode="r")
    return StoredSlopes(
        variables=with_absent(
            {name: np.asarray(group[name][:finished]) for name in VARIABLES if name in group}
        ),
        coordinates={name: np.asarray(group[name][:]) for name in coordinates},
        attributes=attributes,
        complete=complete,
        n_finished=finished,
    )


def _create_store(path: Path, run: Run) -> None:
    """Create the store under a hidden name and rename it, so that it is never seen half made."""
    hidden = path.with_name(f".{path.name}.new")
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir()
    attributes = {
        **run.attributes,
        "n_frames": run.n_frames,
        "n_subapertures": run.n_subapertures,
        _COUNTER: 0,
        _COMPLETE: False,
        _COORDINATES: " ".join(run.coordinates),
    }
    group = zarr.create_group(str(hidden), zarr_format=3, attributes=attributes)
    chunk = min(run.n_frames, max(1, _CHUNK_NUMBERS // run.n_subapertures))
    for name, variable in VARIABLES.items():
        group.create_array(
            name,
            shape=(run.n_frames, run.n_subapertures),
            chunks=(chunk, run.n_subapertures),
            dtype=variable.dtype,
            fill_value=np.nan if variable.dtype == "float32" else 0,
            dimension_names=("frame", "subaperture"),
            attributes={"units": variable.units, "long_name": variable.long_name},
        )
    for name, values in run.coordinates.items():
        units: dict[str, Any] = {"units": COORDINATE_UNITS[name]} if name in COORDINATE_UNITS else {}
        array = group.create_array(
            name, shape=values.shape, dtype=values.dtype, dimension_names=("subaperture",), attributes=units
        )
        array[:] = values
    hidden.rename(path)


def _stored_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store of slopes; KeyError when it is something else."""
    attributes: dict[str, Any] = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
    for name in (_COUNTER, _COMPLETE, "fingerprint", "n_frames", "n_subapertures"):
        attributes[name]
    return attributes


def _replace_attributes(path: Path, changed: Mapping[str, Any]) -> None:
    """Change attributes of the group in one step, which the store's own setter does not promise."""
    metadata = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    metadata["attributes"].update(changed)
    replace_file(path / "zarr.json", json.dumps(metadata, indent=2))
