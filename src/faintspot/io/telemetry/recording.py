"""Telemetry in a Zarr store (format 3) that grows while the engine runs, and reading it back.

Data are appended to the arrays in chunks with checksums (crc32c); then the counters in the group's attributes
are replaced. However the recording ends, the store is valid and the counters count complete data only.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import output_errors
from faintspot.base.sizes import check_bytes, memory_bytes
from faintspot.base.validity import are_valid
from faintspot.io.arrays.zarr_store import (
    TELEMETRY,
    checked_codecs,
    is_store,
    open_store,
    read_items,
    replace_attributes,
    stored_attributes,
)
from faintspot.io.locations import one_line
from faintspot.io.optional_packages import load_zarr
from faintspot.io.stored.slopes_format import VARIABLES

zarr = load_zarr()
FORMAT = TELEMETRY
_FRAMES, _IMAGES = "finished_frames", "finished_images"
_CHUNK_NUMBERS, _CHUNK_BYTES = 1 << 16, 1 << 22
_UNITS = {
    **{name: variable.units for name, variable in VARIABLES.items()},
    **dict.fromkeys(("last_row_time_ns", "published_time_ns", "clock_offset_ns"), "ns"),
    "raw": "adu",
    "denoised": "e-",
}
_DIMENSIONS = {
    "raw": ("image", "row", "column"),
    "denoised": ("image", "subaperture", "window_row", "window_column"),
    "image_frame": ("image",),
    "commands": ("frame", "command"),
}
NOT_IN_ALL = {
    **dict.fromkeys(("late", "lost", "lost_because", "loop"), np.int64),
    **dict.fromkeys(("commands", "covariance_xy"), np.float32),
}
"""Values that some recordings lack, e.g. those of an engine without commands; they are read as zeros."""
_NOT_STORED = "sequence"  # used by the rings only


@dataclass(frozen=True, repr=False)
class Telemetry:
    """Recorded telemetry of an engine: arrays (n_frames,) or (n_frames, n_subapertures), in order of arrival.

    Lost frames are absent, which shows in `frame`.

    Examples
    --------
    >>> from faintspot.io import read_telemetry
    >>> night = read_telemetry("night.zarr", images=False)  # doctest: +SKIP
    >>> night.x.std(axis=0), night.latency_s.max()  # doctest: +SKIP
    """

    frame: NDArray[np.int64]
    """Frame numbers of the camera."""
    method: NDArray[np.int64]
    """Number of the interleaved configuration, an index into ``attributes["methods"]``; 0 without."""
    change: NDArray[np.int64]
    """Number of the last change of settings that applies, see `changes`; 0: none."""
    last_row_time_ns: NDArray[np.int64]
    """Arrival of the last row, CLOCK_MONOTONIC, ns."""
    published_time_ns: NDArray[np.int64]
    """Publication of the slopes, CLOCK_MONOTONIC, ns."""
    clock_offset_ns: NDArray[np.int64]
    """Offset from these times to Unix time by the wall clock at that moment, which may be reset meanwhile."""
    x: NDArray[np.float32]
    """Slopes, px, as in `faintspot.Slopes`; likewise the next ones."""
    y: NDArray[np.float32]
    flux: NDArray[np.float32]
    """Flux in electrons."""
    standard_error_x: NDArray[np.float32]
    """Standard error of x, px."""
    standard_error_y: NDArray[np.float32]
    covariance_xy: NDArray[np.float32]
    """Covariance of the errors of x and y, px^2; 0 in recordings without it."""
    iterations: NDArray[np.int32]
    flags: NDArray[np.uint8]
    """Bits of `faintspot.SubapertureFlag`."""
    late: NDArray[np.int64]
    """Cause of a frame that was late (`faintspot.engine.path.lateness.CAUSES`); 0: in time."""
    lost: NDArray[np.int64]
    """Number of frames that the engine lost since the one before."""
    lost_because: NDArray[np.int64]
    """Cause of the last of them, likewise."""
    loop: NDArray[np.int64]
    """State of the loop: 0 no loop, 1 open, 2 closed."""
    commands: NDArray[np.float32]
    """Commands that follow from each frame, in the interaction matrix's unit, (n_frames, commands)."""
    image_frame: NDArray[np.int64]
    """Numbers of the frames with recorded images, (n_images,)."""
    raw: NDArray[np.float32]
    """Those frames, ADU, (n_images, height, width)."""
    denoised: NDArray[np.float32]
    """Their denoised sub-aperture images, electrons, (n_images, n_subapertures, ny, nx)."""
    changes: list[dict[str, Any]]
    """Changes of settings: frame (the first with it), number, changes (values by name), where (None: all)."""
    attributes: dict[str, Any]
    """Plain values: layout (``Layout(**attributes["layout"])``), initial settings (TOML), methods (names of
    the interleaved configurations), reference (slopes that were subtracted, or None), control (interaction
    matrix and options, see `faintspot.loop.control.recorded`, or None), dropped_records, dropped_images,
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


_PARTS, _CONTROL = "parts", "control"
_WRITTEN_ONCE = _PARTS, _CONTROL
"""Large attributes, in a group of their own: the others are replaced with every block of frames."""
_ARRAYS = tuple(field.name for field in fields(Telemetry) if field.name not in ("changes", "attributes"))


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
        attributes: Mapping[str, Any],
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise InputError(f"{self.path}: already exists; choose another name")
        self.frames = self.images = 0
        """Numbers of complete frames and images in the store."""
        counters = {"format": FORMAT, "version": 1, _FRAMES: 0, _IMAGES: 0, "changes": [], "complete": False}
        with output_errors(self.path):
            _create(self.path, (record_type, image_type), {**attributes, **counters})
        group: Any = zarr.open_group(str(self.path), mode="r+")
        # Write chunks of zeros, too, so that a missing chunk means lost data.
        with zarr.config.set({"array.write_empty_chunks": True}):
            self._arrays: dict[str, Any] = dict(group.arrays())

    def append(self, records: NDArray[Any], images: NDArray[Any], attributes: Mapping[str, Any]) -> None:
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
                start = self.images if "image" in _dimensions(name, values.ndim) else self.frames
                array.resize((start + len(values), *values.shape[1:]))
                array[start:] = values
            frames, images_there = self.frames + len(records), self.images + len(images)
            counters = {_FRAMES: frames, _IMAGES: images_there}
            replace_attributes(self.path, {**attributes, **counters})
        self.frames, self.images = frames, images_there


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
    >>> night = read_telemetry("night.zarr", images=False)  # doctest: +SKIP
    >>> night.x.std(axis=0), night.latency_s.max()  # doctest: +SKIP
    """
    stored = StoredTelemetry(path)
    check_bytes(stored.path, stored.size(images=images), memory_bytes() // 2, "telemetry")
    counts = {"frame": stored.frames, "image": stored.images if images else 0}
    arrays = {name: stored.read(name, 0, counts[_DIMENSIONS.get(name, ("frame",))[0]]) for name in _ARRAYS}
    return Telemetry(**arrays, changes=stored.changes, attributes=stored.attributes)


class StoredTelemetry:
    """A telemetry store at the time of opening, even while it is being written, read in parts.

    Parameters
    ----------
    path : path
        The Zarr store.

    Attributes
    ----------
    path : Path
    attributes : dict
        See `Telemetry.attributes`.
    changes : list of dict
        See `Telemetry.changes`.
    frames, images : int
        Numbers of complete frames and images in the store.

    Raises
    ------
    InputError
        When it is not a telemetry store, or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.attributes = attributes_of(self.path)
        with self._damage():
            self._group: Any = open_store(self.path)
            self.frames, self.images = (int(self.attributes[name]) for name in (_FRAMES, _IMAGES))
            self.changes: list[dict[str, Any]] = self.attributes.pop("changes")
            self.frames_together = int(self._group["x"].chunks[0])
            """Number of frames in a chunk of slopes, which is read as a whole."""

    def __contains__(self, name: str) -> bool:
        """Return whether the store has an array."""
        return name in self._group

    def size(self, *, images: bool) -> int:
        """Return the bytes of all arrays in memory."""
        with self._damage():
            arrays = list(self._group.arrays())
        counted = (array for name, array in arrays if images or "image" not in _dimensions(name, array.ndim))
        return sum(array.nbytes for array in counted)

    def check_shapes(self, kinds: Sequence[np.dtype[np.void]]) -> None:
        """Refuse a store whose arrays do not have these types of records and images.

        Raises
        ------
        InputError
            When an array is missing, or its items have another shape.
        """
        for kind in kinds:
            for name in stored_names(kind):
                wanted = kind[name].shape
                if self.read(name, 0, 0).shape[1:] != wanted:
                    raise InputError(
                        f"{self.path}: the store is damaged ({name}: expected items of {wanted})"
                    )

    def read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of an array, by its name in `Telemetry`.

        Raises
        ------
        InputError
            When the store is damaged there.
        """
        count = stop - start
        with self._damage():
            if name in NOT_IN_ALL and name not in self:
                shape = {"commands": (count, 0), "covariance_xy": (count, self._group["x"].shape[1])}
                return np.zeros(shape.get(name, (count,)), NOT_IN_ALL[name])
            array = self._group[name]
        if stop > array.shape[0]:
            raise InputError(f"{self.path}: the store is damaged ({name}: {array.shape[0]} of {stop})")
        return np.asarray(read_items(self.path, array, start, stop))

    @contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # zarr raises many kinds of errors on broken stores
            raise InputError(f"{self.path}: the store is damaged ({one_line(error)})") from None


def attributes_of(store: Path) -> dict[str, Any]:
    """Return the attributes of a telemetry store.

    Raises
    ------
    InputError
        When the path is not a telemetry store.
    """
    if not store.exists():
        raise InputError(f"{store}: no such file or directory")
    try:
        attributes = stored_attributes(store)
        is_telemetry = attributes["format"] == FORMAT and attributes["version"] == 1
        if (store / _PARTS).is_dir():
            stored = stored_attributes(store / _PARTS)
            attributes |= {_PARTS: stored[_PARTS], _CONTROL: stored.get(_CONTROL)}
    except (OSError, ValueError, KeyError, TypeError):
        is_telemetry = False
    if not (is_telemetry and is_store(store)):
        raise InputError(f"{store}: expected a Zarr store of telemetry from `faintspot realtime record`")
    return attributes


def _create(path: Path, kinds: tuple[np.dtype[np.void], ...], attributes: Mapping[str, Any]) -> None:
    """Create the store under a hidden name and rename it, so that it never appears incomplete."""
    hidden = path.with_name(f".{path.name}.new")
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir()
    rest = {name: value for name, value in attributes.items() if name not in _WRITTEN_ONCE}
    group = zarr.create_group(str(hidden), zarr_format=3, attributes=rest)
    group.create_group(_PARTS, attributes={name: attributes.get(name) for name in _WRITTEN_ONCE})
    for kind in kinds:
        for name, values in _columns(np.empty(0, kind)):
            row = values.shape[1:]
            size = int(np.prod(row)) * values.itemsize
            length = (
                _CHUNK_BYTES // size
                if "image" in _dimensions(name, values.ndim)
                else _CHUNK_NUMBERS // (size // values.itemsize)
            )
            group.create_array(
                name,
                shape=(0, *row),
                chunks=(max(1, length), *row),
                dtype=values.dtype,
                compressors=checked_codecs(),
                dimension_names=_dimensions(name, values.ndim),
                attributes={"units": _UNITS.get(name, "1")},
            )
    hidden.rename(path)


def _columns(items: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """Return the stored fields of a structured array, by name."""
    return [(name, items[name]) for name in stored_names(items.dtype)]


def stored_names(kind: np.dtype[np.void]) -> list[str]:
    """Return the fields of records or images that have an array in a store."""
    return [name for name in kind.names or () if name != _NOT_STORED]


def _dimensions(name: str, count: int) -> tuple[str, ...]:
    """Return the names of an array's dimensions."""
    return _DIMENSIONS.get(name, ("frame", "subaperture")[:count])
