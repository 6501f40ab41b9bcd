"""Reading a telemetry store in parts, for long recordings and for playback."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.zarr_store import open_store, read_items
from faintspot.io.locations import one_line
from faintspot.io.telemetry.recording import NOT_IN_ALL, attributes_of, finished_of, stored_names, zeros_for


class StoredTelemetry:
    """A telemetry store at the time of opening, even while it is being written.

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
        try:
            self._group: Any = open_store(self.path)
            self.frames, self.images = finished_of(self.attributes)
            self.changes: list[dict[str, Any]] = self.attributes.pop("changes")
            self.frames_together = int(self._group["x"].chunks[0])
            """Number of frames in a chunk of slopes, which is read as a whole."""
        except Exception as error:  # zarr raises many kinds of errors on broken stores
            raise InputError(f"{self.path}: the store is damaged ({one_line(error)})") from None

    def __contains__(self, name: str) -> bool:
        """Return whether the store has an array."""
        return name in self._group

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
        if name in NOT_IN_ALL and name not in self:
            return zeros_for(name, stop - start, self._array("x").shape[1])
        array = self._array(name)
        if stop > array.shape[0]:
            raise InputError(f"{self.path}: the store is damaged ({name}: {array.shape[0]} of {stop})")
        return np.asarray(read_items(self.path, array, start, stop))

    def _array(self, name: str) -> Any:
        try:
            return self._group[name]
        except Exception as error:  # as above
            raise InputError(f"{self.path}: the store is damaged ({one_line(error)})") from None
