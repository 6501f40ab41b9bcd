"""Output of slopes, in a format that follows the file name, by a writer that resumes; and reading them."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import check_shape, finite_array, number_between, one_of
from faintspot.base.errors import InputError, MissingExtraError, errors_within, present
from faintspot.base.files import check_regular, output_errors
from faintspot.base.flags import VARIABLES, leave_out, scaled_positions
from faintspot.io.file_format import (
    RESERVED_ATTRIBUTES,
    UNITS,
    FileFormat,
    RecordingHeader,
    StoredSlopes,
    check_memory,
    json_values,
    pixels_in,
)
from faintspot.io.formats.zarr_files import SlopeStore, Zarr, describe_store, remove_store
from faintspot.io.frames import read_array, slope_endings, slope_format
from faintspot.io.slopes_writer import OutputLock, SlopeWriter
from faintspot.io.stored_array import one_line, split_location

_Result = TypeVar("_Result")


def create_writer(
    path: str | Path,
    *,
    n_frames: int,
    n_subapertures: int,
    attributes: Mapping[str, object],
    coordinates: Mapping[str, NDArray[np.generic]],
    overwrite: bool = False,
    measured_attributes: Callable[[], Mapping[str, object]] | None = None,
) -> SlopeWriter:
    """Return a writer of slopes to `path`: .zarr, .fits, .fits.gz, .npz or .csv.

    A .zarr store is valid and readable from the start and states whether it is complete. Other files appear
    only when complete; until then the slopes are in the store "NAME.partial.zarr" beside them, or in memory
    if zarr is not installed. After an interruption, the same call continues where the store stopped; without
    zarr, it starts again.

    Parameters
    ----------
    path : str or Path
        Output; its folder must exist.
    n_frames, n_subapertures : int
        Size of the complete result.
    attributes : mapping
        JSON values that describe the run. `fingerprint` is required and identifies runs that may continue
        each other's output. Common others: configuration (a TOML text), sources, faintspot_version.
    coordinates : mapping
        Values per sub-aperture, (n_subapertures,) each, such as centre_x and centre_y in px.
    overwrite : bool
        Replace a finished output, or another run's: a file when the new one is complete, a .zarr store at
        once. An unfinished output of the same run is still resumed.
    measured_attributes : callable, optional
        Returns further attributes; not called if the output is finished already.

    Raises
    ------
    InputError
        When the ending is unknown, the folder is missing or not writable, or the output is another run's and
        `overwrite` is False; without zarr also when the slopes need too much memory.
    MissingExtraError
        When the package that writes the format is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.io import create_writer, read_slopes
    >>> names = ("x", "y", "flux", "valid", "flags", "iterations", "bad_pixels")
    >>> run = {"n_frames": 5, "n_subapertures": 3, "attributes": {"fingerprint": "mine"}, "coordinates": {}}
    >>> with create_writer("slopes.npz", **run) as writer:
    ...     writer.append(0, {name: np.zeros((5, 3)) for name in names})
    >>> read_slopes("slopes.npz").complete
    True
    """
    path = Path(path)
    run = _checked_run(n_frames, n_subapertures, attributes, coordinates)
    with output_errors(path):
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist; create it or choose another")
        file_format = slope_format(path)
        file_format.require()
        store_path = file_format.store(path)
        export = None if store_path == path else file_format.write
        is_finished = not overwrite and _is_finished(path, file_format, run)
        if is_finished and (export is None or not store_path.exists()):
            return SlopeWriter(path, run)
        if measured_attributes is not None:
            more = json_values(measured_attributes())
            run = replace(run, attributes={**run.attributes, **more})
        if not present("zarr") and not store_path.exists():
            check_memory(path, *run.sizes)
            return SlopeWriter(path, run, export=export)
        lock = OutputLock(path)
        try:
            output = describe_store(store_path)
            if is_finished:  # ended between making the file and removing the store
                if output is not None and (output.fingerprint, output.sizes) == (run.fingerprint, run.sizes):
                    remove_store(store_path)
                lock.release()
                return SlopeWriter(path, run)
            if output is not None:
                output = replace(output, complete=output.complete and export is None)
                if not output.may_be_continued(store_path, run, overwrite=overwrite):
                    remove_store(store_path)
            return SlopeWriter(path, run, lock, export, SlopeStore(store_path, run))
        except BaseException:
            lock.release()
            raise


def read_slopes(path: str | Path, *, unit: str = "px") -> StoredSlopes:
    """Read slopes that `create_writer` wrote; from a .zarr store the finished frames.

    Parameters
    ----------
    path : str or Path
    unit : {"px", "arcsec"}
        Unit of the returned positions and standard errors, stated in attributes["unit"].

    Raises
    ------
    InputError
        When the file is missing or damaged, does not hold slopes, or lacks the pixel scale that the unit
        needs.
    MissingExtraError
        When the package that reads the format is not installed.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.io import read_slopes
    >>> from faintspot.slopes.recorded.measuring import measure_recorded
    >>> fs.Layout.grid((4, 4), pixels=8).save("faintspot.toml")
    >>> fs.Settings("centroid").save("faintspot.toml")
    >>> np.save("frames.npy", np.ones((5, 32, 32)))
    >>> _ = measure_recorded(["frames.npy"], "faintspot.toml", "slopes.npz")
    >>> stored = read_slopes("slopes.npz")
    >>> stored.complete, stored.variables["x"].shape
    (True, (5, 16))
    """
    path = Path(path)
    if not path.exists():
        hint = ""
        if path.name.lower().endswith(tuple(slope_endings())):
            store_path = slope_format(path).store(path)
            hint = f"; an unfinished run left {store_path}" if store_path.exists() else ""
        raise InputError(f"{path}: no such file{hint}")
    if not path.is_dir():
        check_regular(path)
    one_of("unit", unit, UNITS)
    file_format = Zarr() if path.is_dir() else slope_format(path)
    stored = _read(path, lambda file: _consistent(file_format.read(file)))
    before = str(stored.attributes.get("unit", "px"))
    if unit == before:
        return stored
    with errors_within(path):
        factor = pixels_in(unit, stored.attributes) / pixels_in(before, stored.attributes)
    variables = scaled_positions(stored.variables, factor)
    return replace(stored, variables=variables, attributes={**stored.attributes, "unit": unit})


def _consistent(slopes: StoredSlopes) -> StoredSlopes:
    """Return slopes if all quantities are present for all frames; raise ValueError otherwise."""
    shape = slopes.variables["x"].shape
    for name, variable in VARIABLES.items():
        array = slopes.variables[name]
        if array.shape != shape or len(shape) != 2 or array.dtype != variable.dtype:
            raise ValueError(
                f"{name}: expected {variable.dtype} of {shape}, got {array.dtype} of {array.shape}"
            )
    for name, array in slopes.coordinates.items():
        if array.shape != shape[1:] or array.dtype.kind not in "biuf":
            raise ValueError(f"{name}: expected one number for each of {shape[1:]} sub-apertures")
    if not isinstance(slopes.attributes, dict):
        raise ValueError("attributes: expected a table")
    return slopes


def _read(path: Path, read: Callable[[Path], _Result]) -> _Result:
    """Read slopes or a part of them, with errors in one line."""
    try:
        return read(path)
    except (InputError, MissingExtraError):
        raise
    except Exception as error:  # not slopes, or damaged: each package raises its own errors
        raise InputError(f"{path}: expected slopes written by faintspot ({one_line(error)})") from None


def _checked_run(
    n_frames: int, n_subapertures: int, attributes: Mapping[str, object], coordinates: Mapping[str, object]
) -> RecordingHeader:
    """Check the description of the run and convert it to the stored form."""
    frames = int(number_between("n_frames", n_frames, 1, integer=True))
    subapertures = int(number_between("n_subapertures", n_subapertures, 1, integer=True))
    if not isinstance(attributes.get("fingerprint"), str):
        raise InputError("attributes: expected a text named 'fingerprint', which identifies the run")
    for name in RESERVED_ATTRIBUTES & set(attributes):
        raise InputError(f"attributes: {name!r} is reserved by faintspot; choose another name")
    values = {}
    for name, coordinate in coordinates.items():
        if name in VARIABLES or name == "attributes":
            raise InputError(f"coordinates: {name!r} is the name of a variable; choose another name")
        array = finite_array(f"coordinates: {name}", coordinate)
        check_shape(f"coordinates: {name}", array, (subapertures,))
        values[name] = array.astype(np.float64 if array.dtype.kind == "f" else np.int64)
    return RecordingHeader(frames, subapertures, json_values(attributes), values)


def _is_finished(path: Path, file_format: FileFormat, run: RecordingHeader) -> bool:
    """Return whether this run has completed the output before; refuse another run's output."""
    output = _read(path, file_format.finished)
    return output is not None and output.may_be_continued(path, run, overwrite=False)


def read_reference(location: str | Path) -> NDArray[Any]:
    """Read reference positions for `SlopePipeline`.

    Parameters
    ----------
    location : str or Path
        File of slopes written by faintspot, e.g. of a flat wavefront, or an array as for `read_array`. Slopes
        give the mean of each sub-aperture's valid positions, including the reference that was subtracted. A
        sub-aperture without valid slopes takes the median displacement of the others: a source that is
        displaced as a whole is a tilt.

    Returns
    -------
    (n, 2) array
        x and y, px; an array is returned as stored, and may also be (2n,): all x, then all y.

    Raises
    ------
    InputError
        When the file is missing, damaged, of another format, or has no valid slopes.
    MissingExtraError
        When the package that reads the format is not installed.
    """
    path, key = split_location(location)
    if key is None and holds_slopes(path):
        return _mean_positions(path, read_slopes(path))
    return read_array(location)


def holds_slopes(path: Path) -> bool:
    """Return whether a path is a file of slopes written by faintspot, as far as its names say.

    Raises
    ------
    MissingExtraError
        When the package that reads the format is not installed.
    """
    if not path.name.lower().endswith(tuple(slope_endings())):
        return False
    form = slope_format(path)
    form.require()
    return form.has_slopes(path)


def _mean_positions(path: Path, slopes: StoredSlopes) -> NDArray[np.float64]:
    """Return the mean of the valid slopes of each sub-aperture, (n, 2), px from its centre."""
    valid = slopes.variables["valid"]
    count = np.count_nonzero(valid, axis=0)
    if not count.any():
        _, left_out = leave_out(slopes.variables["flags"])
        raise InputError(f"{path}: expected valid slopes to take as reference, found none ({left_out})")
    sums = [np.sum(slopes.variables[name], axis=0, where=valid, dtype=np.float64) for name in ("x", "y")]
    means: NDArray[np.float64] = np.stack(sums, axis=1) / np.maximum(count, 1)[:, np.newaxis]
    means[count == 0] = np.median(means[count > 0], axis=0)
    means += subtracted_reference(slopes)
    return means


def subtracted_reference(slopes: StoredSlopes) -> NDArray[np.float64]:
    """Return the reference that was subtracted from slopes, (n, 2), px from each sub-aperture's centre."""
    zero = np.zeros((slopes.variables["x"].shape[1], 2))
    reference: NDArray[np.float64] = np.asarray(slopes.attributes.get("reference", zero), np.float64)
    return reference.reshape(2, -1).T if reference.ndim == 1 else reference
