"""Slopes of an unfinished run in a hidden folder beside the output file.

The folder ".NAME.partial" holds a flat binary file for each variable, and a mark: the number of complete
frames and the run's fingerprint. The output appears complete by renaming; until then the data exist twice on
the disk.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular, parse_json, read_bytes, replace_file, sync_file, sync_folder
from faintspot.base.sizes import MOST_TEXT_BYTES
from faintspot.io.stored.slopes_format import VARIABLES, RecordingHeader, StoredSlopes
from faintspot.io.stored.slopes_writer import ExistingOutput

_RUN = "run.json"
_MARK = "finished"


class FolderStorage:
    """Storage of slopes in a folder, from which the output file is made when all are there.

    Parameters
    ----------
    path : Path
        Output file.
    run : Run
        Description of its contents.
    export : callable
        Writes the file: export(stream, slopes).
    """

    chunk = 1

    def __init__(
        self, path: Path, run: RecordingHeader, export: Callable[[IO[bytes], StoredSlopes], None]
    ) -> None:
        self.place = partial_folder(path)
        self._path = path
        self._run = run
        self._export = export

    def begun(self) -> ExistingOutput | None:
        """Return the description of the existing folder, or None."""
        if not is_partial(self.place):
            return None
        description = _read_description(self.place)
        sizes = (description["n_frames"], description["n_subapertures"])
        return ExistingOutput(description["attributes"]["fingerprint"], sizes, complete=False)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.place)

    def create(self) -> None:
        """Create the folder; run.json is written last and marks it as usable."""
        shutil.rmtree(self.place, ignore_errors=True)
        self.place.mkdir()
        for name in VARIABLES:
            (self.place / name).touch()
        self.mark(0)
        description = {
            "n_frames": self._run.n_frames,
            "n_subapertures": self._run.n_subapertures,
            "attributes": self._run.attributes,
            "coordinates": {name: values.tolist() for name, values in self._run.coordinates.items()},
        }
        replace_file(self.place / _RUN, json.dumps(description))

    def open(self) -> None:
        """Do nothing: no file stays open."""

    def marked(self) -> tuple[str, int]:
        """Return the fingerprint and the number of complete frames."""
        return _read_mark(self.place)

    def mark(self, finished: int) -> None:
        """Wait for the disk, then write the number of complete frames."""
        for name in VARIABLES:
            sync_file(self.place / name)
        replace_file(self.place / _MARK, f"{finished}\n{self._run.fingerprint}")

    def read(self, start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Return stored frames."""
        stored = read_partial(self.place).variables
        return {name: np.array(array[start:stop]) for name, array in stored.items()}

    def write(self, start: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store frames from `start` on."""
        for name, array in arrays.items():
            with (self.place / name).open("r+b") as stream:
                stream.seek(start * self._run.n_subapertures * array.itemsize)
                stream.write(np.ascontiguousarray(array).data)

    def finish(self) -> None:
        """Make the file and remove the folder."""
        temporary = self.place / "output"  # removed with the folder after an interruption
        with temporary.open("wb") as stream:
            self._export(stream, read_partial(self.place))
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(self._path)
        sync_folder(self._path.parent)
        shutil.rmtree(self.place)


def partial_folder(path: Path) -> Path:
    """Return the hidden folder beside `path` for the slopes of an unfinished run."""
    return path.with_name(f".{path.name}.partial")


def is_partial(folder: Path) -> bool:
    """Return whether a folder belongs to an unfinished run."""
    return (folder / _RUN).is_file()


def read_partial(folder: Path) -> StoredSlopes:
    """Return the slopes that an unfinished run has stored, memory-mapped."""
    description = _read_description(folder)
    finished = _read_mark(folder)[1]
    shape = (finished, description["n_subapertures"])
    variables: dict[str, NDArray[Any]] = {}
    for name, variable in VARIABLES.items():
        empty = np.empty(shape, variable.dtype)
        check_regular(folder / name)
        variables[name] = np.memmap(folder / name, variable.dtype, "r", shape=shape) if finished else empty
    return StoredSlopes(
        variables=variables,
        coordinates={name: np.asarray(values) for name, values in description["coordinates"].items()},
        attributes=description["attributes"],
        complete=False,
        n_finished=finished,
    )


def _read_description(folder: Path) -> dict[str, Any]:
    try:
        text = read_bytes(folder / _RUN, "a description", MOST_TEXT_BYTES)
        description: dict[str, Any] = parse_json(text)
    except ValueError:
        raise _damaged(folder) from None
    return description


def _read_mark(folder: Path) -> tuple[str, int]:
    """Return the fingerprint and the number of complete frames."""
    try:
        finished, _, fingerprint = read_bytes(folder / _MARK, "a mark", 1 << 10).decode().partition("\n")
        return fingerprint, int(finished)
    except (OSError, ValueError):
        raise _damaged(folder) from None


def _damaged(folder: Path) -> InputError:
    return InputError(f"{folder}: damaged, cannot be resumed; delete it")
