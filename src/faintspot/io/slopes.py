"""Slopes out: one writer by the name's ending, resumable; and slopes read back."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import finite_array, number_between
from faintspot.errors import InputError
from faintspot.files import output_errors
from faintspot.io import slopes_export as export
from faintspot.io.locations import one_line
from faintspot.io.slopes_file import (
    FileWriter,
    FinishedWriter,
    is_partial,
    partial_folder,
    prepare_partial,
    read_partial,
    remove_leftovers,
)
from faintspot.io.slopes_format import (
    RESERVED_ATTRIBUTES,
    VARIABLES,
    Run,
    SlopeWriter,
    StoredSlopes,
    belongs_to_another_run,
    exists_already,
    json_values,
)

_Export = Callable[[IO[bytes], StoredSlopes], None]
_Import = Callable[[Path], StoredSlopes]
_FORMATS: Mapping[str, tuple[_Export, _Import]] = {
    ".npz": (export.write_npz, export.read_npz),
    ".csv": (export.write_csv, export.read_csv),
    ".fits.gz": (export.write_fits_gz, export.read_fits),
    ".fits": (export.write_fits, export.read_fits),
}


def create_writer(
    path: str | Path,
    *,
    n_frames: int,
    n_subapertures: int,
    attributes: Mapping[str, Any],
    coordinates: Mapping[str, NDArray[Any]],
    resume: bool = True,
    overwrite: bool = False,
) -> SlopeWriter:
    """Return a writer of slopes to `path`: .zarr, .fits, .fits.gz, .npz or .csv.

    A .zarr store is there, valid and readable, from the start, and says whether it is complete. The others
    appear only when complete; until then the slopes are in the hidden folder ".NAME.partial" beside them.
    Interrupted in whatever way, the same call continues where the output stopped.

    Parameters
    ----------
    path : str or Path
        The output; its folder must exist.
    n_frames, n_subapertures : int
        The size of the whole result.
    attributes : mapping
        JSON values that describe the run; `fingerprint` is required and says which runs are the same one.
        Usual others: configuration (a TOML text), sources, faintspot_version.
    coordinates : mapping
        Per sub-aperture, (n_subapertures,) each, as centre_x and centre_y in px.
    resume : bool
        Continue an unfinished output of the same fingerprint; a finished one is then left as it is.
    overwrite : bool
        Replace a finished output, or another run's: a file when the new one is complete, a .zarr store
        at once. An unfinished output of the same run is still resumed if `resume`.

    Raises
    ------
    InputError
        When the name's ending is unknown, the folder is missing or not writable, or the output is another
        run's and `overwrite` is False.
    MissingExtraError
        When the package that writes the format is not installed.
    """
    path = Path(path)
    run = _checked_run(n_frames, n_subapertures, attributes, coordinates)
    with output_errors(path):
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist: create it or choose another")
        if path.name.lower().endswith(".zarr"):
            from faintspot.io.slopes_zarr import ZarrWriter, prepare_store

            prepare_store(path, run, resume=resume, overwrite=overwrite)
            return ZarrWriter(path, run)
        write, read = _FORMATS[_ending(path)]
        if write in (export.write_fits, export.write_fits_gz):
            import faintspot.io.fits_files  # noqa: F401  says that astropy is missing before the work, not after
        if path.exists() and not overwrite:
            return _completed(path, run, read, resume=resume)
        prepare_partial(path, run, resume=resume, overwrite=overwrite)
        return FileWriter(path, run, write)


def read_slopes(path: str | Path) -> StoredSlopes:
    """Read slopes that `create_writer` wrote; of a .zarr store or a ".partial" folder what is finished.

    Raises
    ------
    InputError
        When there is no such file, it is damaged, or it does not hold slopes.
    MissingExtraError
        When the package that reads the format is not installed.
    """
    path = Path(path)
    if not path.exists():
        partial = partial_folder(path)
        hint = f"; an unfinished run has left {partial}" if is_partial(partial) else ""
        raise InputError(f"{path}: no such file{hint}")
    read: _Import
    if is_partial(path):
        read = read_partial
    elif path.is_dir():
        from faintspot.io.slopes_zarr import read_store as read
    else:
        read = _FORMATS[_ending(path)][1]
    try:
        return read(path)
    except (
        KeyError,
        ValueError,
        OSError,
        EOFError,
        TypeError,
        AttributeError,
        BadZipFile,
        zlib.error,
    ) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected slopes written by faintspot ({one_line(error)})") from None


def _checked_run(
    n_frames: int, n_subapertures: int, attributes: Mapping[str, Any], coordinates: Mapping[str, Any]
) -> Run:
    """Check what describes the run and bring it into the form that is stored."""
    frames = int(number_between("n_frames", n_frames, 1, integer=True))
    subapertures = int(number_between("n_subapertures", n_subapertures, 1, integer=True))
    if not isinstance(attributes.get("fingerprint"), str):
        raise InputError("attributes: expected a text named 'fingerprint', which tells one run from another")
    for name in RESERVED_ATTRIBUTES & set(attributes):
        raise InputError(f"attributes: {name!r} is written by faintspot itself: expected another name")
    values = {}
    for name, coordinate in coordinates.items():
        if name in VARIABLES or name == "attributes":
            raise InputError(f"coordinates: {name!r} is the name of a variable: expected another")
        array = finite_array(f"coordinates: {name}", coordinate)
        if array.shape != (subapertures,):
            raise InputError(f"coordinates: {name}: expected shape ({subapertures},), got {array.shape}")
        values[name] = array.astype(np.float64 if array.dtype.kind == "f" else np.int64)
    return Run(frames, subapertures, json_values("attributes", attributes), values)


def _ending(path: Path) -> str:
    for ending in _FORMATS:
        if path.name.lower().endswith(ending):
            return ending
    raise InputError(f"{path}: expected a name that ends with .zarr, .fits, .fits.gz, .npz or .csv")


def _completed(path: Path, run: Run, read: _Import, *, resume: bool) -> SlopeWriter:
    """Return the writer of a file that this very run has completed before; refuse any other."""
    if read is export.read_csv or not resume or not path.is_file():
        raise exists_already(path)
    stored = read_slopes(path)
    sizes = stored.variables["x"].shape
    if stored.attributes.get("fingerprint") != run.fingerprint or sizes != run.sizes:
        raise belongs_to_another_run(path)
    remove_leftovers(path, run)
    return FinishedWriter(run.n_frames)
