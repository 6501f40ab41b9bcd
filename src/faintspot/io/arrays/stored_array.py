"""An array in a file, opened for the first read and read in parts."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.closing import Closing
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.sizes import check_bytes
from faintspot.io.locations import one_line

MOST_WHOLE_BYTES = 1 << 30
"""Largest size of an array, or of a part of one, that can only be read whole."""

MOST_CHUNKS = 1 << 14
"""Most chunks of a frame, and of a part that is read at once: libraries need kilobytes for each."""

OpenArray = Callable[[ExitStack], Any]
"""Opens a file on a stack of contexts and returns an array that gives its items by ``array[start:stop]``."""


class StoredArray(Closing):
    """An array in a file whose first axis is read in parts; for one thread at a time.

    Parameters
    ----------
    name : str
        File and key, for messages.
    shape : tuple of int
        Shape stated by the file.
    dtype : numpy.dtype
        Type of the values, in any byte order; `read` returns them in native order.
    open_array : callable
        See `OpenArray`; it and the returned array may raise any error on damaged files.
    note : str
        How the file was understood, if that is not evident.
    matlab : bool
        Whether MATLAB's last axis was put first.
    chunks : tuple of int, optional
        Shape of the chunks in which the values are stored.
    compressions : int
        Number of times that a chunk is compressed.

    Raises
    ------
    InputError
        When a chunk is too large, compressed more than once, or there are too many for an item.
    """

    def __init__(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype[np.generic],
        open_array: OpenArray,
        *,
        note: str = "",
        matlab: bool = False,
        chunks: tuple[int, ...] | None = None,
        compressions: int = 0,
    ) -> None:
        self.note, self.matlab = note, matlab
        self.name, self.shape = name, tuple(int(side) for side in shape)
        self.dtype: np.dtype[Any] = dtype.newbyteorder("=")
        self._open_array = open_array
        self._open_files = ExitStack()
        self._array: Any = None
        self._most_items = math.inf
        if chunks:
            sides = zip(self.shape[1:], chunks[1:], strict=True)
            of_item = max(math.prod(-(-side // max(chunk, 1)) for side, chunk in sides), 1)
            check_bytes(name, math.prod(chunks) * dtype.itemsize, MOST_WHOLE_BYTES, "a chunk")
            if of_item > MOST_CHUNKS:
                raise InputError(
                    f"{name}: has {of_item:,} chunks in a frame, expected at most {MOST_CHUNKS:,}; save it "
                    "in larger chunks"
                )
            self._most_items = max(MOST_CHUNKS // of_item, 1) * max(chunks[0], 1)
        if compressions > 1:
            raise InputError(
                f"{name}: is compressed {compressions} times, so that its size is not known; compress it once"
            )

    @classmethod
    def whole(
        cls,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype[np.generic],
        load: Callable[[], NDArray[Any]],
        **options: Any,
    ) -> StoredArray:
        """Return an array that can only be read whole, by `load`; refuse one that needs too much memory."""
        check_bytes(name, math.prod(shape) * dtype.itemsize, MOST_WHOLE_BYTES, "an array")
        return cls(name, shape, dtype, lambda _: load(), **options)

    def opened(self, files: ExitStack) -> Any:
        """Open the file on another stack; see `OpenArray`."""
        return self._open_array(files)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, C-ordered; the array belongs to the caller.

        Raises
        ------
        InputError
            When the file is damaged or incomplete; the message names the items.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if self._array is None:
                    self._array = self._open_array(self._open_files)
                values = self._values(start, stop)
            if values.shape != (stop - start, *self.shape[1:]):
                raise ValueError(f"its shape is {values.shape[1:]} instead of {self.shape[1:]}")
        except (InputError, MissingExtraError):
            raise
        except Exception as error:  # decoders raise many kinds of errors on damaged files
            self.close()
            items = "frames" if len(self.shape) == 3 else "rows"
            raise InputError(
                f"{self.name}: {items} {start} to {stop - 1} (counted from 0) cannot be read: "
                f"the file is damaged or incomplete ({one_line(error)})"
            ) from None
        # Values without memory of their own are a part of a mapped or whole array.
        return np.array(values, self.dtype, order="C", copy=None if values.flags.owndata else True)

    def _values(self, start: int, stop: int) -> NDArray[Any]:
        if stop - start <= self._most_items:
            return np.asarray(self._array[start:stop])
        step = int(self._most_items)
        parts = [self._array[first : min(first + step, stop)] for first in range(start, stop, step)]
        return np.concatenate(parts)

    def close(self) -> None:
        """Close the file; a later `read` opens it again."""
        self._array = None
        self._open_files.close()
