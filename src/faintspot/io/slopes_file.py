"""Slopes to one file (.npz, .fits, .csv): collected in a hidden folder beside it, then made in one go.

The folder ".NAME.partial" holds a flat binary file for each variable and a counter. A block is written to all
of them before the counter moves on, so the counter never includes a block that is not whole, however the
program ends. The file itself appears by renaming, complete. Until then its data exist twice on the disk.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.files import output_errors, replace_file
from faintspot.io.slopes_format import (
    VARIABLES,
    Run,
    StoredSlopes,
    belongs_to_another_run,
    checked_block,
    exists_already,
    with_absent,
)

_RUN = "run.json"
_COUNTER = "finished"


class FileWriter:
    """Collects slopes in a folder and makes the file of them when all are there.

    Parameters
    ----------
    path : Path
        The file to be made.
    run : Run
        What it will contain.
    export : callable
        Writes the file: export(stream, slopes, run).
    """

    def __init__(self, path: Path, run: Run, export: Callable[[IO[bytes], StoredSlopes], None]) -> None:
        self._path = path
        self._run = run
        self._export = export
        self._folder = partial_folder(path)
        with output_errors(path):
            if not (self._folder / _RUN).exists():
                self._create_folder()
        self._finished = _read_counter(self._folder)

    def finished(self) -> int:
        """Return how many frames are stored: the next block starts there."""
        return self._finished

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Add a block of frames: data first, then the counter."""
        arrays = checked_block(self._run, self._finished, start, block)
        with output_errors(self._path):
            for name, array in arrays.items():
                with (self._folder / name).open("r+b") as stream:
                    stream.seek(start * self._run.n_subapertures * array.itemsize)
                    stream.write(np.ascontiguousarray(array).data)
            finished = start + len(arrays["x"])
            replace_file(self._folder / _COUNTER, str(finished))
        self._finished = finished

    def close(self) -> None:
        """Make the file when all frames are there; otherwise leave the folder to be resumed."""
        if self._finished < self._run.n_frames or not self._folder.exists():
            return
        temporary = self._folder / "output"
        with output_errors(self._path):
            slopes = read_partial(self._folder)
            with temporary.open("wb") as stream:
                self._export(stream, slopes)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, self._path)
            shutil.rmtree(self._folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _create_folder(self) -> None:
        """Create the folder; run.json comes last and marks that it is usable."""
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        for name in VARIABLES:
            (self._folder / name).touch()
        (self._folder / _COUNTER).write_text("0")
        description = {
            "n_frames": self._run.n_frames,
            "n_subapertures": self._run.n_subapertures,
            "attributes": self._run.attributes,
            "coordinates": {name: values.tolist() for name, values in self._run.coordinates.items()},
        }
        replace_file(self._folder / _RUN, json.dumps(description))


class FinishedWriter:
    """Stands for an output that an earlier, equal run has completed: nothing is left to do."""

    def __init__(self, n_frames: int) -> None:
        self._n_frames = n_frames

    def finished(self) -> int:
        """Return the number of frames, all of them."""
        return self._n_frames

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Refuse: the output is complete."""
        raise InputError(f"slopes: the output is complete with {self._n_frames} frames, got frame {start}")

    def close(self) -> None:
        """Nothing is open."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def partial_folder(path: Path) -> Path:
    """Return the hidden folder beside `path` where an unfinished run keeps its slopes."""
    return path.with_name(f".{path.name}.partial")


def is_partial(folder: Path) -> bool:
    """Tell whether a folder is an unfinished run's."""
    return (folder / _RUN).is_file()


def read_partial(folder: Path) -> StoredSlopes:
    """Return what an unfinished run has stored so far, mapped from the disk."""
    description = _read_description(folder)
    finished = _read_counter(folder)
    shape = (finished, description["n_subapertures"])
    variables: dict[str, NDArray[Any]] = {}
    for name, variable in VARIABLES.items():
        empty = np.empty(shape, variable.dtype)
        if (folder / name).exists():
            variables[name] = (
                np.memmap(folder / name, variable.dtype, "r", shape=shape) if finished else empty
            )
    return StoredSlopes(
        variables=with_absent(variables),
        coordinates={name: np.asarray(values) for name, values in description["coordinates"].items()},
        attributes=description["attributes"],
        complete=False,
        n_finished=finished,
    )


def prepare_partial(path: Path, run: Run, *, resume: bool, overwrite: bool) -> None:
    """Keep the folder of an unfinished run when it is this one; remove it or refuse when it is another.

    Raises
    ------
    InputError
        When it belongs to another run, or must not be resumed, and `overwrite` is False.
    """
    folder = partial_folder(path)
    if not is_partial(folder):
        return
    equal = _is_same_run(folder, run)
    if equal and resume:
        return
    if not overwrite:
        raise exists_already(folder) if equal else belongs_to_another_run(folder)
    with output_errors(path):
        shutil.rmtree(folder)


def remove_leftovers(path: Path, run: Run) -> None:
    """Remove the folder that this run has left when it ended between making the file and tidying up."""
    folder = partial_folder(path)
    if not is_partial(folder) or _is_same_run(folder, run):
        shutil.rmtree(folder, ignore_errors=True)


def _is_same_run(folder: Path, run: Run) -> bool:
    description = _read_description(folder)
    sizes = (description["n_frames"], description["n_subapertures"])
    return description["attributes"]["fingerprint"] == run.fingerprint and sizes == run.sizes


def _read_description(folder: Path) -> dict[str, Any]:
    try:
        description: dict[str, Any] = json.loads((folder / _RUN).read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(f"{folder}: damaged, it cannot be resumed: delete it") from None
    return description


def _read_counter(folder: Path) -> int:
    try:
        return int((folder / _COUNTER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(f"{folder}: damaged, it cannot be resumed: delete it") from None
