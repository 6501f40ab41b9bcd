"""Recorded telemetry, read from its store also while the engine runs; frame numbers left out."""

import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.errors import InputError, load_package
from faintspot.base.files import check_bytes, memory_bytes
from faintspot.base.flags import VARIABLES, are_valid
from faintspot.io.stored_array import one_line
from faintspot.io.zarr_store import TELEMETRY, is_store, open_store, read_items, stored_attributes

zarr = load_package("zarr")
FRAMES, IMAGES = "finished_frames", "finished_images"
"""Attributes of a store: numbers of complete frames and images."""
CLOSED_LOOP = 2
"""State of a closed loop in `Telemetry.loop`."""
CONTROL = "control"
"""A large attribute, in a group of its own: the others are replaced with every block of frames."""
_NOT_STORED = "sequence"  # used by the rings only


class ArrayStorage(NamedTuple):
    """Storage of an array of telemetry."""

    dtype: np.dtype[np.generic]
    dimensions: tuple[str, ...]
    units: str
    in_all: bool
    """Whether all recordings have it; else it is read as zeros, e.g. commands of an engine without any."""


def array(dtype: Any, dimensions: str, units: str = "1", *, in_all: bool = True) -> dict[str, ArrayStorage]:
    """Return the metadata of a field of `Telemetry`; dimensions are words."""
    return {"stored": ArrayStorage(np.dtype(dtype), tuple(dimensions.split()), units, in_all)}


def of_slopes(name: str, dtype: object, *, in_all: bool = True) -> dict[str, ArrayStorage]:
    """Return those of a quantity of each slope."""
    return array(dtype, "frame subaperture", VARIABLES[name].units, in_all=in_all)


@dataclass(frozen=True, repr=False)
class Telemetry:
    """Recorded telemetry of an engine: arrays (n_frames,) or (n_frames, n_subapertures), in order of arrival.

    Lost frames are absent, which shows in `frame`.

    Examples
    --------
    >>> from faintspot.io import read_telemetry
    >>> recording = read_telemetry("night.zarr", images=False)  # doctest: +SKIP
    >>> recording.x.std(axis=0), recording.latency_s.max()  # doctest: +SKIP
    """

    frame: NDArray[np.int64] = field(metadata=array(np.int64, "frame"))
    """Frame numbers of the camera."""
    method: NDArray[np.int64] = field(metadata=array(np.int64, "frame"))
    """Number of the interleaved configuration, an index into ``attributes["methods"]``; 0 without."""
    change: NDArray[np.int64] = field(metadata=array(np.int64, "frame"))
    """Number of the last change of settings that applies, see `changes`; 0: none."""
    last_row_time_ns: NDArray[np.int64] = field(metadata=array(np.int64, "frame", "ns"))
    """Arrival of the last row, CLOCK_MONOTONIC, ns."""
    published_time_ns: NDArray[np.int64] = field(metadata=array(np.int64, "frame", "ns"))
    """Publication of the slopes, CLOCK_MONOTONIC, ns."""
    clock_offset_ns: NDArray[np.int64] = field(metadata=array(np.int64, "frame", "ns"))
    """Offset from these times to Unix time by the wall clock at that moment, which may be reset meanwhile."""
    late: NDArray[np.int64] = field(metadata=array(np.int64, "frame", in_all=False))
    """Cause of a frame that was late (`faintspot.engine.frames.timing.CAUSES`); 0: in time."""
    lost: NDArray[np.int64] = field(metadata=array(np.int64, "frame", in_all=False))
    """Number of frames that the engine lost since the one before."""
    lost_because: NDArray[np.int64] = field(metadata=array(np.int64, "frame", in_all=False))
    """Cause of the last of them, likewise."""
    x: NDArray[np.float32] = field(metadata=of_slopes("x", np.float32))
    """Slopes, px, as in `faintspot.Slopes`; likewise the next ones."""
    y: NDArray[np.float32] = field(metadata=of_slopes("y", np.float32))
    flux: NDArray[np.float32] = field(metadata=of_slopes("flux", np.float32))
    """Flux in electrons."""
    standard_error_x: NDArray[np.float32] = field(metadata=of_slopes("standard_error_x", np.float32))
    """Standard error of x, px."""
    standard_error_y: NDArray[np.float32] = field(metadata=of_slopes("standard_error_y", np.float32))
    covariance_xy: NDArray[np.float32] = field(metadata=of_slopes("covariance_xy", np.float32, in_all=False))
    """Covariance of the errors of x and y, px^2; 0 in recordings without it."""
    iterations: NDArray[np.int32] = field(metadata=of_slopes("iterations", np.int32))
    flags: NDArray[np.uint8] = field(metadata=of_slopes("flags", np.uint8))
    """Bits of `faintspot.SubapertureFlag`."""
    loop: NDArray[np.int64] = field(metadata=array(np.int64, "frame", in_all=False))
    """State of the loop: 0 no loop, 1 open, 2 closed."""
    commands: NDArray[np.float32] = field(metadata=array(np.float32, "frame command", in_all=False))
    """Commands that follow from each frame, in the interaction matrix's unit, (n_frames, commands)."""
    image_frame: NDArray[np.int64] = field(metadata=array(np.int64, "image"))
    """Numbers of the frames with recorded images, (n_images,)."""
    raw: NDArray[np.float32] = field(metadata=array(np.float32, "image row column", "adu"))
    """Those frames, ADU, (n_images, height, width)."""
    denoised: NDArray[np.float32] = field(
        metadata=array(np.float32, "image subaperture window_row window_column", "e-")
    )
    """Their denoised sub-aperture images, electrons, (n_images, n_subapertures, ny, nx)."""
    changes: list[dict[str, Any]]
    """Changes of settings: frame (the first with it), number, changes (values by name), where (None: all)."""
    attributes: dict[str, Any]
    """Plain values: layout (``Layout(**attributes["layout"])``), initial settings (TOML), methods (names of
    the interleaved configurations); reference (slopes that were subtracted) and control (interaction matrix
    and options, see `faintspot.loop.control.options`), each or None; dropped_records, dropped_images,
    dropped_changes, complete, ended_because."""

    def __repr__(self) -> str:
        """Return the numbers of frames, sub-apertures, images and changes."""
        return (
            f"Telemetry({len(self.frame)} frames, {self.x.shape[-1]} sub-apertures, "
            f"{len(self.image_frame)} images, {len(self.changes)} changes of settings)"
        )

    @property
    def slopes(self) -> NDArray[np.float32]:
        """Slopes for a reconstructor, px, (n_frames, 2 n_subapertures): all x, then all y."""
        return np.concatenate([self.x, self.y], axis=-1)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each slope was measured, and is not flagged as probably wrong."""
        return are_valid(self.flags)

    @property
    def latency_s(self) -> NDArray[np.float64]:
        """Latency from the last row to the slopes, (n_frames,)."""
        return (self.published_time_ns - self.last_row_time_ns) / 1e9

    @property
    def unix_time_s(self) -> NDArray[np.float64]:
        """Unix time of the arrival of the last row, (n_frames,).

        Taken from the wall clock at the first frame: it never decreases, even if the wall clock was reset.
        """
        offset = self.clock_offset_ns[0] if len(self.clock_offset_ns) else 0
        return (self.last_row_time_ns + offset) / 1e9


ARRAYS: dict[str, ArrayStorage] = {
    item.name: item.metadata["stored"] for item in fields(Telemetry) if item.metadata
}


def item_type(item: str, sizes: Mapping[str, int], without: Collection[str] = ()) -> np.dtype[np.void]:
    """Return the type of a record ("frame") or of an "image": `sequence`, and the arrays of `Telemetry`.

    Each array begins at a multiple of its numbers' size.

    Parameters
    ----------
    item : str
    sizes : mapping
        Sizes of the other dimensions.
    without : collection of str
        Arrays to leave out.
    """
    columns: list[object] = [(_NOT_STORED, np.int64)]
    for name, stored in ARRAYS.items():
        first, *others = stored.dimensions
        if first == item and name not in without:
            columns.append((name, stored.dtype, tuple(sizes[other] for other in others)))
    return np.dtype(columns, align=True)


def read_telemetry(path: str | Path, *, images: bool = True) -> Telemetry:
    """Read a recording of `faintspot realtime record`, even while it is being written.

    Parameters
    ----------
    path : path
        The Zarr store.
    images : bool
        Whether to read the images, which need the most memory; otherwise there are none.

    Returns
    -------
    Telemetry

    Raises
    ------
    InputError
        When it is not a telemetry store, or damaged.

    Examples
    --------
    >>> from faintspot.io import read_telemetry
    >>> recording = read_telemetry("night.zarr", images=False)  # doctest: +SKIP
    >>> recording.x.std(axis=0), recording.latency_s.max()  # doctest: +SKIP
    """
    path = Path(path)
    attributes = _attributes(path)
    try:
        return _read(path, attributes, images)
    except InputError:
        raise
    except Exception as error:  # zarr raises many kinds of errors on broken stores
        raise InputError(f"{path}: the store is damaged ({one_line(error)})") from None


def _read(path: Path, attributes: dict[str, Any], images: bool) -> Telemetry:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files that a recorder has not finished
        stored = dict(open_store(path).arrays())
    sizes = {"frame": int(attributes[FRAMES]), "image": int(attributes[IMAGES]) if images else 0}
    sizes |= {"command": 0, "subaperture": stored["x"].shape[1]}
    total = sum(array.nbytes for name, array in stored.items() if images or name not in ("raw", "denoised"))
    check_bytes(path, total, memory_bytes() // 2, "telemetry")
    arrays: dict[str, Any] = {}
    for name, kind in ARRAYS.items():
        length = sizes[kind.dimensions[0]]
        if name not in stored and not kind.in_all:
            arrays[name] = np.zeros([sizes[dimension] for dimension in kind.dimensions], kind.dtype)
            continue
        if length > stored[name].shape[0]:
            raise InputError(f"{path}: the store is damaged ({name}: {stored[name].shape[0]} of {length})")
        arrays[name] = np.asarray(read_items(path, stored[name], 0, length))
    return Telemetry(**arrays, changes=attributes.pop("changes"), attributes=attributes)


def _attributes(store: Path) -> dict[str, Any]:
    """Return the attributes of a telemetry store.

    Raises
    ------
    InputError
        When it is something else.
    """
    if not store.exists():
        raise InputError(f"{store}: no such file or directory")
    try:
        attributes = stored_attributes(store)
        is_telemetry = attributes["format"] == TELEMETRY and attributes["version"] == 1
        if (store / CONTROL).is_dir():
            attributes |= stored_attributes(store / CONTROL)
    except (OSError, ValueError, KeyError, TypeError):
        is_telemetry = False
    if not (is_telemetry and is_store(store)):
        raise InputError(f"{store}: expected a Zarr store of telemetry from `faintspot realtime record`")
    return attributes


def stored_names(kind: np.dtype[np.void]) -> list[str]:
    """Return the fields of records or images that have an array in a store."""
    return [name for name in kind.names or () if name != _NOT_STORED]


LARGEST_GAP = 1_000_000
"""Largest number of frames lost in a row, 17 minutes at 1 kHz; a larger gap counts as a restart."""


def left_out(before: int, after: int) -> int:
    """Return how many numbers are missing between two, or -1 if the source restarted.

    It restarted if the later number is not larger, or is larger by more than `LARGEST_GAP`.
    """
    between = after - before - 1
    return between if 0 <= between <= LARGEST_GAP else -1


def all_left_out(numbers: ArrayLike) -> NDArray[np.int64]:
    """Return `left_out` for every pair of successive numbers, (n - 1,)."""
    between = np.diff(np.asarray(numbers, np.int64)) - 1
    return np.where((between >= 0) & (between <= LARGEST_GAP), between, -1)
