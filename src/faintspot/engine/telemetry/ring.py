"""Telemetry: the engine's data of each frame, passed through shared memory to recorders and displays.

The engine's thread writes; any number of processes of the same user read. The writer never waits. A reader
that is too slow loses the oldest records and gets their number. One segment, NAME_telemetry, holds three
rings: a record for every frame, pixel images of some frames, and changes of settings.

Item k of a ring is in place k % length (see `engine.processes.segment`). An item is written first and counted
afterwards (`kernels.ordered`). The next item overwrites the oldest, which a reader already counts
as lost.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between
from faintspot.base.text_files import parse_json, plain_values, to_json
from faintspot.engine.processes.segment import CLOSED, Segment
from faintspot.io.telemetry import item_type
from faintspot.slopes.kernels.ordered import fence, load, store
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout

CHANGE_BYTES = 4096
"""Bytes per place in the ring of changes: the length of the text (8 bytes), then the text."""
CHANGE_SLOTS = 256


def record_type(n: int, commands: int = 0) -> np.dtype[np.void]:
    """Return the type of a record of n sub-apertures; see `faintspot.io.Telemetry`.

    `sequence` counts the records from 0. Without commands, it has neither these nor the loop's state.
    """
    without = () if commands else ("loop", "commands")
    return item_type("frame", {"subaperture": n, "command": commands}, without)


def image_type(frame_shape: tuple[int, int], n: int, window: tuple[int, int]) -> np.dtype[np.void]:
    """Return the type of an item of the ring of images: the frame, ADU, and denoised images, electrons."""
    names = ("row", "column", "window_row", "window_column")
    sizes = dict(zip(names, (*frame_shape, *window), strict=True))
    return item_type("image", {**sizes, "subaperture": n})


class Ring:
    """One of the rings: its places, and the count of items ever written.

    Attributes
    ----------
    items : structured array
        Places in shared memory.
    kind : dtype
        Type of an item.
    """

    def __init__(self, cell: NDArray[np.int64], items: NDArray[np.void]) -> None:
        self.items, self.kind, self._cell = items, items.dtype, cell

    @property
    def written(self) -> int:
        """Number of items ever written, which is the cursor after the newest."""
        count: int = load(self._cell, 0)
        return count

    def count(self, written: int) -> None:
        """Set the number of items written."""
        store(self._cell, 0, written)
        fence()  # before the next item overwrites the oldest

    def since(self, cursor: int, most: int | None = None) -> tuple[NDArray[np.void], int, int]:
        """Return copies of the items from a cursor on, in order.

        Parameters
        ----------
        cursor : int
            Number of the next item to read; 0: from the oldest one available.
        most : int, optional
            Maximum number of items; the oldest are returned. Default: all available.

        Returns
        -------
        items : structured array, (m,)
        cursor : int
            Cursor for the next call.
        dropped : int
            Items that were overwritten before they could be copied.
        """
        slots, written = len(self.items), self.written
        first = max(cursor, written - slots + 1)  # one place may be in use by the writer
        last = max(first, written if most is None else min(written, first + most))
        copies = self.items[np.arange(first, last) % slots]
        fence()  # before checking what was overwritten meanwhile
        overwritten = min(max(self.written - slots + 1 - first, 0), len(copies))
        return copies[overwritten:], last, first - cursor + overwritten


def layout_values(layout: Layout) -> dict[str, object]:
    """Return a layout as plain values, from which `Layout` can be rebuilt."""
    values: dict[str, object] = plain_values(vars(layout))
    return values


_SUFFIX = "_telemetry"
_HEAD = struct.Struct("<10q")
_OF_SLOPES = (
    *("x", "y", "flux", "standard_error_x", "standard_error_y", "covariance_xy"),
    *("iterations", "flags"),
)
_VALUES = attrgetter(*_OF_SLOPES)
_RECORD_BYTES, _IMAGE_BYTES = 1 << 25, 1 << 24  # small enough for a container's 64 MiB of shared memory


class TelemetryRing(Segment):
    """An engine's telemetry, made by `create` (the writer) or `attach` (a reader).

    Records, images and changes may be written from three threads, each kind from one thread only.

    Attributes
    ----------
    name : str
        Name of the engine.
    records, images, changes : Ring
        Records of all frames, images of some, and changes of settings; see `record_type` and `image_type`.
        Their cells count the items ever written.
    layout : Layout
    """

    what, writer = "ring of telemetry", "engine"

    def __init__(self, *parts: Any) -> None:
        """Use `create` or `attach` instead."""
        super().__init__(*parts)
        self.name = self.name.removesuffix(_SUFFIX)
        self.records, self.images, self.changes = (
            Ring(self.cells[row], items) for row, items in enumerate(self.rings.values(), CLOSED + 1)
        )
        self.layout = Layout(**self.description["layout"])
        items = self.records.items
        self._memory, self._written = items.view(np.uint8).data, 0
        self._slots, self._itemsize = len(items), items.itemsize
        # One array per field; each row is the target of one copy, without temporary objects.
        self._targets = [items[name] for name in _OF_SLOPES]
        if self.description["commands"]:
            self._loop, self._commands = items["loop"], items["commands"]

    @classmethod
    def contents(cls, description: Mapping[str, Any]) -> tuple[int, dict[str, tuple[np.dtype[Any], int]]]:
        """See `Segment`."""
        layout = description["layout"]
        n, shape, window = len(layout["corners"]), tuple(layout["frame_shape"]), tuple(layout["window"])
        change = np.dtype([("length", np.int64), ("text", np.uint8, (CHANGE_BYTES - 8,))])
        rings = {
            "records": (record_type(n, description["commands"]), description["records"]),
            "images": (image_type(shape, n, window), description["image_slots"]),
            "changes": (change, CHANGE_SLOTS),
        }
        return CLOSED + 1 + len(rings), rings

    @classmethod
    def create(
        cls,
        name: str,
        layout: Layout,
        *,
        commands: int = 0,
        records: int | None = None,
        image_slots: int | None = None,
        **described: object,
    ) -> TelemetryRing:
        """Create the rings of an engine.

        Parameters
        ----------
        name : str
            Name of the engine; the segment is /dev/shm/NAME_telemetry.
        layout : Layout
        commands : int
            Number of the mirror's commands; 0: none.
        records : int, optional
            Number of records, about 60 + 29 n bytes each: a reader may lag by one frame less. Default: as
            many as fit into 32 MiB, up to 4096.
        image_slots : int, optional
            Number of images. Default: as many as fit into 16 MiB, 2 to 16.
        **described
            Values for the readers: `settings`, the initial ones as TOML text; `methods`, names of the
            interleaved configurations; `reference`, the reference slopes that were subtracted, (2 n,) [px];
            `control`, as `packed_control` returns it.

        Raises
        ------
        InputError
            When a living process writes telemetry of that name, shared memory is short, or a value is out of
            range.
        """
        n = len(layout)
        if records is None:
            records = min(4096, max(2, _RECORD_BYTES // record_type(n, commands).itemsize))
        if image_slots is None:
            size = image_type(layout.frame_shape, n, layout.window).itemsize
            image_slots = min(16, max(2, _IMAGE_BYTES // size))
        description = {
            "settings": "",
            "methods": [],
            **dict.fromkeys(("reference", "control")),
            **described,
            "layout": layout_values(layout),
            "commands": commands,
            "records": int(number_between("records", records, 2, 1 << 24, integer=True)),
            "image_slots": int(number_between("image_slots", image_slots, 2, 1 << 16, integer=True)),
        }
        return cls._created(f"{name}{_SUFFIX}", description)

    @classmethod
    def attach(cls, name: str) -> TelemetryRing:
        """Open the telemetry of an engine.

        Raises
        ------
        InputError
            When there is no such telemetry, or it is not of this version and user.
        """
        return cls._attached(f"{name}{_SUFFIX}")

    def write(
        self,
        frame: int,
        method: int,
        change: int,
        times_ns: tuple[int, int],
        slopes: Slopes,
        *,
        causes: tuple[int, int, int] = (0, 0, 0),
        loop: int = 0,
        commands: NDArray[np.float64] | None = None,
    ) -> None:
        """Write the record of one frame: takes a few microseconds, never waits, checks nothing.

        Parameters
        ----------
        frame : int
            Frame number of the camera.
        method, change : int
            Numbers of the interleaved configuration and of the last change of settings that applies.
        times_ns : (int, int)
            Times of CLOCK_MONOTONIC of the last row and of publication, ns.
        slopes : Slopes
            Slopes of one frame; copied.
        causes : (int, int, int)
            Cause of lateness, number of frames lost before this one, and the cause, as in `record_type`.
        loop : int
            State of the loop, as in `record_type`.
        commands : (commands,) array, optional
            Commands that follow from the slopes; needed if the telemetry has commands.
        """
        written = self._written
        slot = written % self._slots
        _HEAD.pack_into(
            self._memory,
            slot * self._itemsize,
            written,
            frame,
            method,
            change,
            *times_ns,
            time.time_ns() - time.monotonic_ns(),
            *causes,
        )
        for target, values in zip(self._targets, _VALUES(slopes), strict=True):
            target[slot] = values
        if commands is not None:
            self._loop[slot], self._commands[slot] = loop, commands
        self._written = written = written + 1
        self.records.count(written)

    def write_images(self, frame: int, raw: ArrayLike, denoised: ArrayLike) -> None:
        """Write images of one frame: the frame itself (h, w), ADU, and denoised (n, ny, nx), electrons."""
        ring = self.images
        written = ring.written
        item = ring.items[written % len(ring.items)]
        item["sequence"], item["image_frame"] = written, frame
        item["raw"][...] = raw
        item["denoised"][...] = denoised
        ring.count(written + 1)

    def write_change(
        self, frame: int, number: int, changes: Mapping[str, object], where: Sequence[int] | None
    ) -> None:
        """Write a change of settings that has taken effect.

        If the change is longer than 4 KiB, only its names are written, and a note that it was too long.

        Parameters
        ----------
        frame : int
            First frame that was measured with it.
        number : int
            Number of the change, as in `write`.
        changes : mapping
            New values by name.
        where : sequence of int, optional
            Indices of the sub-apertures; None: all.
        """
        head = {"frame": int(frame), "number": int(number)}
        entry = {**head, "changes": dict(changes), "where": where}
        text = to_json(entry).encode()
        if len(text) > CHANGE_BYTES - 8:
            names = dict.fromkeys(list(changes)[:20], "too long")
            short = {**head, "changes": names, "where": "too long", "too_long_bytes": len(text)}
            text = to_json(short).encode()
        ring = self.changes
        written = ring.written
        item = ring.items[written % len(ring.items)]
        item["length"] = len(text)
        item["text"][: len(text)] = np.frombuffer(text, np.uint8)
        ring.count(written + 1)

    def changes_since(self, cursor: int) -> tuple[list[dict[str, Any]], int, int]:
        """Return the changes of settings from a cursor on, as `Ring.since` does.

        Each has frame, number, changes (values by name) and where (sub-apertures, None for all).
        """
        items, cursor, dropped = self.changes.since(cursor)
        changes = [parse_json(item["text"][: item["length"]].tobytes()) for item in items]
        return changes, cursor, dropped
