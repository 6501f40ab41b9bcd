"""Telemetry: what the engine did with each frame, through shared memory to whoever records or watches it.

The engine's thread writes, any number of processes of the same user read; the writer never waits. A reader
that is too slow loses the oldest records and is told how many. There are three rings in one segment, named
NAME_telemetry: a record for every frame, pixel images of some frames, and changes of settings.

The segment is that of a pixel ring with a single slot, of bytes (see `faintspot.realtime.pixel_segment`),
so that it is created, found stale and replaced in the same way. The slot holds::

    magic, length and checksum of the description; the description, JSON text
    three counts, 128 bytes apart: records, images, changes ever written
    the three rings, item k of a ring in place k % length

An item is written first and counted afterwards (`faintspot.kernels.ordered`). The item that comes next
overwrites the oldest, which is why a reader counts that one as lost already.
"""

from __future__ import annotations

import json
import os
import secrets
import struct
import time
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between
from faintspot.base.closing import Closing
from faintspot.base.errors import InputError
from faintspot.kernels.ordered import fence
from faintspot.pipeline.slopes import Slopes
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.pixel_segment import Header, create_segment, segment_path
from faintspot.realtime.processes import process_start
from faintspot.realtime.telemetry_segment import (
    CHANGE_BYTES,
    CHANGE_SLOTS,
    PAGE,
    Rings,
    image_type,
    kinds_of,
    layout_values,
    plain,
    record_type,
    up_to_pages,
)
from faintspot.sensor.layout import Layout

__all__ = ["TelemetryReader", "TelemetryRing"]

_MAGIC = b"fstelem1"
_START = struct.Struct("<8sII")
_HEAD = struct.Struct("<7q")
_BYTE = np.dtype(np.uint8)
_RECORD_BYTES, _IMAGE_BYTES = 1 << 25, 1 << 24  # small enough for a container's 64 MiB of shared memory


class TelemetryRing(Closing):
    """The writer's side, made by `create`. As a context manager it closes itself.

    Records, images and changes may come from three threads, but each of them from one alone.

    Attributes
    ----------
    name : str
        The engine's.
    """

    def __init__(self, name: str, ring: PixelRing, begin: int, description: Mapping[str, Any]) -> None:
        """For `create` only."""
        self.name, self._ring = name, ring
        self._memory = ring.pixels[0, 0].data
        self._rings = rings = Rings(ring.pixels[0, 0], begin, description)
        self._written = 0
        items = rings.records.items
        self._places, self._itemsize, self._begin = len(items), items.itemsize, rings.first_record
        # A column each; a row of it is the target of one copy, for which nothing else is made.
        self._x, self._y, self._flux = items["x"], items["y"], items["flux"]
        self._error_x, self._error_y = items["standard_error_x"], items["standard_error_y"]
        self._iterations, self._flags = items["iterations"], items["flags"]
        if description["commands"]:
            self._loop, self._commands = items["loop"], items["commands"]

    @classmethod
    def create(
        cls,
        name: str,
        layout: Layout,
        *,
        settings: str = "",
        arms: Sequence[str] = (),
        commands: int = 0,
        reference: ArrayLike | None = None,
        parts: Mapping[str, str] | None = None,
        records: int | None = None,
        image_slots: int | None = None,
    ) -> TelemetryRing:
        """Make the rings of an engine.

        Parameters
        ----------
        name : str
            The engine's; the segment is /dev/shm/NAME_telemetry.
        layout : Layout
        settings : str
            The settings to begin with, for readers: TOML text (`faintspot.pipeline.configuration.to_text`).
        arms : sequence of str, optional
            Names of the arms of interleaved settings, for readers.
        commands : int
            Number of the mirror's commands; 0: the engine makes none.
        reference : (2 n,) array, optional
            Reference slopes that are subtracted, px, for readers.
        parts : mapping, optional
            Calibration, PSF and score, for readers (`faintspot.pipeline.configuration.packed`).
        records : int, optional
            Places for records of about 60 + 25 n bytes: a reader may lag behind by one frame less. Default:
            as many as fit into 32 MiB, up to 4096.
        image_slots : int, optional
            Places for images. Default: as many as fit into 16 MiB, 2 to 16.

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
            "layout": layout_values(layout),
            "settings": settings,
            "arms": list(arms),
            "commands": commands,
            "reference": None if reference is None else np.asarray(reference).tolist(),
            "parts": parts,
            "records": int(number_between("records", records, 2, 1 << 24, integer=True)),
            "image_slots": int(number_between("image_slots", image_slots, 2, 1 << 16, integer=True)),
            "change_slots": CHANGE_SLOTS,
        }
        ring, begin = _segment(name, description)
        return cls(name, ring, begin, description)

    def write(
        self,
        frame: int,
        arm: int,
        change: int,
        last_row_ns: int,
        published_ns: int,
        slopes: Slopes,
        loop: int = 0,
        commands: NDArray[np.float64] | None = None,
    ) -> None:
        """Write the record of one frame; a few microseconds, nobody is waited for, nothing is checked.

        Parameters
        ----------
        frame : int
            The camera's number.
        arm, change : int
            Which of interleaved settings, and the number of the last change of settings that is in them.
        last_row_ns, published_ns : int
            CLOCK_MONOTONIC, ns.
        slopes : Slopes
            Of one frame; copied.
        loop : int
            The loop's state, as `record_type` has it.
        commands : (commands,) array, optional
            That followed from the slopes; needed where the telemetry has commands.
        """
        written = self._written
        place = written % self._places
        _HEAD.pack_into(
            self._memory,
            self._begin + place * self._itemsize,
            written,
            frame,
            arm,
            change,
            last_row_ns,
            published_ns,
            time.time_ns() - time.monotonic_ns(),
        )
        self._x[place], self._y[place], self._flux[place] = slopes.x, slopes.y, slopes.flux
        self._error_x[place], self._error_y[place] = slopes.standard_error_x, slopes.standard_error_y
        self._iterations[place], self._flags[place] = slopes.iterations, slopes.flags
        if commands is not None:
            self._loop[place], self._commands[place] = loop, commands
        self._written = written = written + 1
        self._rings.records.count(written)

    def write_images(self, frame: int, raw: ArrayLike, denoised: ArrayLike) -> None:
        """Write images of one frame: the frame itself (h, w), ADU, and denoised (n, ny, nx), electrons."""
        ring = self._rings.images
        written = ring.written
        item = ring.items[written % len(ring.items)]
        item["sequence"], item["image_frame"] = written, frame
        item["raw"][...] = raw
        item["denoised"][...] = denoised
        ring.count(written + 1)

    def write_change(
        self, frame: int, number: int, changes: Mapping[str, Any], where: Sequence[int] | None
    ) -> None:
        """Write a change of settings that has taken effect.

        Of one that is too long for its place (4 KiB) the names alone are written, and that it was.

        Parameters
        ----------
        frame : int
            The first one that was measured with it.
        number : int
            Of the change, as in `write`.
        changes : mapping
            New values by name.
        where : sequence of int, optional
            Sub-apertures; None: all.
        """
        place = {"frame": int(frame), "number": int(number)}
        whole = {**place, "changes": dict(changes), "where": where}
        text = json.dumps(whole, default=plain).encode()
        if len(text) > CHANGE_BYTES - 8:
            names = dict.fromkeys(list(changes)[:20], "too long")
            short = {**place, "changes": names, "where": "too long", "too_long_bytes": len(text)}
            text = json.dumps(short).encode()
        ring = self._rings.changes
        written = ring.written
        item = ring.items[written % len(ring.items)]
        item["length"] = len(text)
        item["text"][: len(text)] = np.frombuffer(text, np.uint8)
        ring.count(written + 1)

    def close(self) -> None:
        """Remove the segment's name and tell readers that nothing more comes. Harmless when repeated."""
        self._ring.close()


class TelemetryReader:
    """A reader's side, made by `attach`.

    A cursor is the number of the next item that a reader has not seen; 0: begin with the oldest there is.

    Attributes
    ----------
    name : str
        The engine's.
    layout : Layout
    settings : str
        With which the engine began: TOML text.
    description : dict
        What the writer says of itself, as plain values.
    """

    def __init__(self, name: str, ring: PixelRing, begin: int, description: dict[str, Any]) -> None:
        """For `attach` only."""
        self.name, self._ring, self.description = name, ring, description
        self.layout = Layout(**description["layout"])
        self.settings: str = description["settings"]
        self._rings = Rings(ring.pixels[0, 0], begin, description)

    @classmethod
    def attach(cls, name: str) -> TelemetryReader:
        """Open the telemetry of an engine.

        Raises
        ------
        InputError
            When there is none of that name, or it is not of this version and this user.
        """
        path = segment_path(f"{name}_telemetry")
        if not path.exists():
            raise InputError(f"{path}: there is no telemetry of {name!r}; is the engine running?")
        ring = PixelRing.attach(path.name)
        memory = ring.pixels[0, 0]
        magic, length, checksum = _START.unpack_from(memory) if len(memory) >= _START.size else (b"", 0, 0)
        text = memory[_START.size : _START.size + length].tobytes()
        if magic != _MAGIC or zlib.crc32(text) != checksum:
            raise InputError(f"{path}: is not telemetry of this version of faintspot")
        return cls(name, ring, up_to_pages(_START.size + length), json.loads(text))

    @property
    def newest(self) -> int:
        """Cursor behind the newest record: what comes from now on."""
        return self._rings.records.written

    @property
    def newest_image(self) -> int:
        """Cursor behind the newest images."""
        return self._rings.images.written

    @property
    def record_type(self) -> np.dtype[np.void]:
        """Type of the records, see `record_type`."""
        return self._rings.records.items.dtype

    @property
    def image_type(self) -> np.dtype[np.void]:
        """Type of the images, see `image_type`."""
        return self._rings.images.items.dtype

    @property
    def stale(self) -> bool:
        """Whether nothing more comes: the engine has ended or died, or another one has taken its name.

        What is there can still be read.
        """
        return self._ring.closed or self._ring.stale

    def records_since(self, cursor: int, most: int | None = None) -> tuple[NDArray[Any], int, int]:
        """Return copies of the records from a cursor on, in their order.

        Parameters
        ----------
        cursor : int
        most : int, optional
            Not more than so many, the oldest. Default: all that there are.

        Returns
        -------
        records : structured array, (m,)
            See `record_type`.
        cursor : int
            For the next call.
        dropped : int
            Records that were overwritten before they could be copied.
        """
        return self._rings.records.since(cursor, most)

    def images_since(self, cursor: int, most: int | None = None) -> tuple[NDArray[Any], int, int]:
        """Return copies of the images from a cursor on, as `records_since` does; see `image_type`."""
        return self._rings.images.since(cursor, most)

    def changes_since(self, cursor: int) -> tuple[list[dict[str, Any]], int, int]:
        """Return the changes of settings from a cursor on, as `records_since` does.

        Each has frame, number, changes (values by name) and where (sub-apertures, None for all).
        """
        items, cursor, dropped = self._rings.changes.since(cursor, None)
        changes = [json.loads(item["text"][: item["length"]].tobytes()) for item in items]
        return changes, cursor, dropped

    def close(self) -> None:
        """Let go of the segment."""
        self._ring.close()


def _segment(name: str, description: Mapping[str, Any]) -> tuple[PixelRing, int]:
    """Make the segment, with its description and empty rings; return it and where the rings begin."""
    text = json.dumps(description).encode()
    begin = up_to_pages(_START.size + len(text))
    rings = sum(up_to_pages(kind.itemsize * places) for kind, places in kinds_of(description))
    pid, segment = os.getpid(), f"{name}_telemetry"
    size = begin + PAGE + rings
    header = Header(pid, process_start(pid), secrets.randbits(64), 1, size, 1, _BYTE.str)
    try:
        memory, identity = create_segment(segment_path(segment), header)
    except InputError as error:
        raise InputError(f"telemetry of {name}: {error}") from None
    ring = PixelRing(segment, memory, header, identity)
    slot = ring.pixels[0, 0]
    slot[::PAGE] = 0  # every page is there before the first frame
    slot[_START.size : _START.size + len(text)] = np.frombuffer(text, np.uint8)
    fence()
    _START.pack_into(slot.data, 0, _MAGIC, len(text), zlib.crc32(text))  # last: now it may be read
    return ring, begin
