"""Segment of telemetry: the types of its three rings, and reading and writing them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.base.json_text import plain_values
from faintspot.io.telemetry.recording import item_type
from faintspot.slopes.kernels.compilation.ordered import fence, load, store
from faintspot.slopes.sensor.layout import Layout

CHANGE_BYTES = 4096
"""Bytes per place in the ring of changes: the length of the text (8 bytes), then the text."""
CHANGE_SLOTS = 256


def record_type(n: int, commands: int = 0) -> np.dtype[np.void]:
    """Return the type of a record of n sub-apertures; see `faintspot.io.Telemetry`.

    `sequence` counts the records from 0. Without commands, it has neither these nor the loop's state.
    """
    without = () if commands else ("loop", "commands")
    return item_type("frame", {"subaperture": n, "command": commands}, without, align=True)


def image_type(frame_shape: tuple[int, int], n: int, window: tuple[int, int]) -> np.dtype[np.void]:
    """Return the type of an item of the ring of images: the frame, ADU, and denoised images, electrons."""
    names = ("row", "column", "window_row", "window_column")
    sizes = dict(zip(names, (*frame_shape, *window), strict=True))
    return item_type("image", {**sizes, "subaperture": n}, align=True)


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
