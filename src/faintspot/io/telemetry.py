"""Telemetry in a Zarr store (format 3) that grows while the engine runs, and reading it back.

Whatever is written goes to the end of the arrays, in chunks with checksums (crc32c); then the counters in the
group's attributes are replaced. However the recording ends, the store is valid and the counters include only
what is whole.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import output_errors
from faintspot.base.flags import INVALID
from faintspot.base.sizes import check_bytes, memory_bytes
from faintspot.io.locations import one_line
from faintspot.io.optional_packages import load_zarr
from faintspot.io.slopes_format import VARIABLES
from faintspot.io.zarr_store import (
    TELEMETRY,
    checked_codecs,
    is_store,
    open_store,
    read_items,
    replace_attributes,
    stored_attributes,
)

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
_NO_LOOP: dict[str, NDArray[Any]] = {
    "loop": np.zeros((0,), np.int64),
    "commands": np.zeros((0, 0), np.float32),
}
"""Of a frame, in recordings of engines that make no commands."""
_NOT_STORED = "sequence"  # of the rings, which a store has no use for


@dataclass(frozen=True, repr=False)
class Telemetry:
    """What was recorded of a running engine: (n_frames,) or (n_frames, n_subapertures), as it came.

    Frames that were lost are absent; `frame` tells.

    Examples
    --------
    >>> from faintspot.io import read_telemetry
    >>> night = read_telemetry("night.zarr", images=False)  # doctest: +SKIP
    >>> night.x.std(axis=0), night.latency_s.max()  # doctest: +SKIP
    """

    frame: NDArray[np.int64]
    """The camera's number of each frame."""
    arm: NDArray[np.int64]
    """Which of interleaved settings it was measured with, a place in ``attributes["arms"]``; 0 without."""
    change: NDArray[np.int64]
    """Number of the last change of settings that it was measured with, see `changes`; 0: none."""
    last_row_time_ns: NDArray[np.int64]
    """When its last row had arrived, CLOCK_MONOTONIC, ns."""
    published_time_ns: NDArray[np.int64]
    """When its slopes were published."""
    clock_offset_ns: NDArray[np.int64]
    """Added to the times: Unix time by the wall clock of that moment, which may be set meanwhile."""
    x: NDArray[np.float32]
    """Slopes, px, as in `faintspot.Slopes`; so are the next ones."""
    y: NDArray[np.float32]
    flux: NDArray[np.float32]
    """Electrons."""
    standard_error_x: NDArray[np.float32]
    """px."""
    standard_error_y: NDArray[np.float32]
    iterations: NDArray[np.int32]
    flags: NDArray[np.uint8]
    """Bits of `faintspot.SubapertureFlag`."""
    loop: NDArray[np.int64]
    """The loop's state: 0 there is none, 1 open, 2 closed."""
    commands: NDArray[np.float32]
    """Commands that followed from each frame, in the interaction matrix's unit, (n_frames, commands)."""
    image_frame: NDArray[np.int64]
    """Numbers of the frames whose images were recorded, (n_images,)."""
    raw: NDArray[np.float32]
    """Those frames, ADU, (n_images, height, width)."""
    denoised: NDArray[np.float32]
    """Their sub-aperture images after denoising, electrons, (n_images, n_subapertures, ny, nx)."""
    changes: list[dict[str, Any]]
    """Changes of settings: frame (the first with it), number, changes (values by name), where (None: all)."""
    attributes: dict[str, Any]
    """Plain values: layout (``Layout(**attributes["layout"])``), settings to begin with (TOML text), arms
    (names of the interleaved settings), reference (slopes that were subtracted, or None), dropped_records,
    dropped_images, dropped_changes, complete, ended_because."""

    def __repr__(self) -> str:
        """Say how much there is."""
        return (
            f"Telemetry({len(self.frame)} frames, {self.x.shape[-1]} sub-apertures, "
            f"{len(self.image_frame)} images, {len(self.changes)} changes of settings)"
        )

    @property
    def slopes(self) -> NDArray[np.float32]:
        """All x, then all y, px, (n_frames, 2 n_subapertures): what a reconstructor multiplies."""
        return np.concatenate([self.x, self.y], axis=-1)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each slope was measured."""
        return (self.flags & INVALID) == 0  # type: ignore[no-any-return]

    @property
    def latency_s(self) -> NDArray[np.float64]:
        """From the last row to the slopes, (n_frames,)."""
        return (self.published_time_ns - self.last_row_time_ns) / 1e9

    @property
    def unix_time_s(self) -> NDArray[np.float64]:
        """When the last row had arrived, Unix time, (n_frames,).

        By the wall clock at the first frame: it never goes back, also where the wall clock was set.
        """
        offset = self.clock_offset_ns[0] if len(self.clock_offset_ns) else 0
        return (self.last_row_time_ns + offset) / 1e9


_PARTS = "parts"
_ARRAYS = tuple(field.name for field in fields(Telemetry) if field.name not in ("changes", "attributes"))


class TelemetryStore:
    """Writes telemetry to a new Zarr store.

    Parameters
    ----------
    path : path
        A directory that does not exist yet.
    record_type, image_type : structured dtype
        Of what is appended: a field an array of the store.
    attributes : mapping
        JSON values.

    Raises
    ------
    InputError
        When something is there already, or it cannot be written.
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
            raise InputError(f"{self.path}: exists already: choose another name")
        self.frames = self.images = 0
        """Frames and images that are whole in the store."""
        counters = {"format": FORMAT, "version": 1, _FRAMES: 0, _IMAGES: 0, "changes": [], "complete": False}
        with output_errors(self.path):
            _create(self.path, (record_type, image_type), {**attributes, **counters})
        group: Any = zarr.open_group(str(self.path), mode="r+")
        # A chunk of zeros is written like any other: one that is not there has been lost.
        with zarr.config.set({"array.write_empty_chunks": True}):
            self._arrays: dict[str, Any] = dict(group.arrays())

    def append(self, records: NDArray[Any], images: NDArray[Any], attributes: Mapping[str, Any]) -> None:
        """Add records and images and replace attributes; when it returns, they are in the store.

        Raises
        ------
        InputError
            When the disk is full or not writable; what was there before can still be read.
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
    """Read what `faintspot realtime record` has written, also while it is still writing.

    Parameters
    ----------
    path : path
        The Zarr store.
    images : bool
        Whether to read the images, which need the most memory; else there are none.

    Returns
    -------
    Telemetry

    Raises
    ------
    InputError
        When it is not a store of telemetry, or damaged.

    Examples
    --------
    >>> from faintspot.io import read_telemetry
    >>> night = read_telemetry("night.zarr", images=False)  # doctest: +SKIP
    >>> night.x.std(axis=0), night.latency_s.max()  # doctest: +SKIP
    """
    store = Path(path)
    attributes = attributes_of(store)
    try:
        group: Any = open_store(store)
        finished = {"frame": int(attributes[_FRAMES]), "image": int(attributes[_IMAGES]) if images else 0}
        arrays = {}
        total = sum(
            array.nbytes
            for name, array in group.arrays()
            if images or "image" not in _dimensions(name, array.ndim)
        )
        check_bytes(store, total, memory_bytes() // 2, "telemetry")
        for name in _ARRAYS:
            if name in _NO_LOOP and name not in group:
                arrays[name] = np.zeros((finished["frame"], *_NO_LOOP[name].shape[1:]), _NO_LOOP[name].dtype)
                continue
            array = group[name]
            count = finished[_dimensions(name, array.ndim)[0]]
            if count > array.shape[0]:
                raise ValueError(f"{name}: expected {count}, found {array.shape[0]}")
            arrays[name] = read_items(store, array, 0, count)
        changes = attributes.pop("changes")
    except InputError:
        raise
    except Exception as error:  # a broken store makes zarr raise many things
        raise InputError(f"{store}: the store is damaged ({one_line(error)})") from None
    return Telemetry(**arrays, changes=changes, attributes=attributes)


def attributes_of(store: Path) -> dict[str, Any]:
    """Return what a store of telemetry says of itself.

    Raises
    ------
    InputError
        When it is none.
    """
    if not store.exists():
        raise InputError(f"{store}: no such file or directory")
    try:
        attributes = stored_attributes(store)
        known = attributes["format"] == FORMAT and attributes["version"] == 1
        if (store / _PARTS).is_dir():
            attributes[_PARTS] = stored_attributes(store / _PARTS)[_PARTS]
    except (OSError, ValueError, KeyError, TypeError):
        known = False
    if not (known and is_store(store)):
        raise InputError(
            f"{store}: expected a Zarr store of telemetry, as `faintspot realtime record` writes"
        )
    return attributes


def finished_of(attributes: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many frames and images are whole in a store with these attributes."""
    return int(attributes[_FRAMES]), int(attributes[_IMAGES])


def _create(path: Path, kinds: tuple[np.dtype[np.void], ...], attributes: Mapping[str, Any]) -> None:
    """Create the store under a hidden name and rename it, so that it is never seen half made."""
    hidden = path.with_name(f".{path.name}.new")
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir()
    rest = {name: value for name, value in attributes.items() if name != _PARTS}
    group = zarr.create_group(str(hidden), zarr_format=3, attributes=rest)
    # Large, and written once: the attributes of the store are replaced with every block of frames.
    group.create_group(_PARTS, attributes={_PARTS: attributes.get(_PARTS)})
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
    """The fields of a structured array that are stored, by name."""
    return [(name, items[name]) for name in stored_names(items.dtype)]


def stored_names(kind: np.dtype[np.void]) -> list[str]:
    """Return the fields of records or images that a store has an array for."""
    return [name for name in kind.names or () if name != _NOT_STORED]


def _dimensions(name: str, count: int) -> tuple[str, ...]:
    """Names of an array's dimensions."""
    return _DIMENSIONS.get(name, ("frame", "subaperture")[:count])
