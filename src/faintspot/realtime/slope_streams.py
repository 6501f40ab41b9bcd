"""Slopes out: streams of pyshmem, which pyRTC and, through its bridge, ImageStreamIO read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from faintspot.errors import InputError, MissingExtraError
from faintspot.kernels.compiling import Direct
from faintspot.kernels.details import fill_details
from faintspot.pipeline import Slopes

DETAILS = ("flux_e", "valid", "standard_error_x_px", "standard_error_y_px", "iterations", "flags")
"""Rows of the stream of details."""
MARKS = ("frame", "arm", "settings_change", "last_row_ns", "published_ns")
"""What the stream of marks holds; times are those of CLOCK_MONOTONIC."""


class SlopeStreams:
    """Three streams, each stamped with the frame's number as `frame_id`.

    NAME_slopes holds all x, then all y, float32 px (2 n,): what a reconstructor multiplies. NAME_details
    holds (6, n) float32, rows as `DETAILS`; NAME_marks holds with what and when it was measured, int64, as
    `MARKS`. The slopes are published first.

    Parameters
    ----------
    name : str
    n : int
        Number of sub-apertures.

    Raises
    ------
    MissingExtraError
        Without pyshmem.
    InputError
        When a living process publishes under that name.
    """

    def __init__(self, name: str, n: int) -> None:
        self._slopes = _created(f"{name}_slopes", (2 * n,))
        self._details = _created(f"{name}_details", (len(DETAILS), n))
        self._marks = _created(f"{name}_marks", (len(MARKS),), np.int64)
        self._n = n
        self._fill = Direct(fill_details)
        self._counts = np.zeros(3, np.int64)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep the streams' locks, which only writers need, while publishing: readers do not wait for them.

        Taking a lock for every frame would take three times as long as publishing itself.
        """
        with self._slopes.locked(), self._details.locked(), self._marks.locked():
            yield

    def publish_slopes(self, slopes: Slopes, frame: int) -> None:
        """Publish the vector of slopes; by the thread that holds the streams."""
        with self._slopes.write_view_locked(frame_id=frame) as vector:
            vector[: self._n] = slopes.x
            vector[self._n :] = slopes.y

    def publish_details(self, slopes: Slopes, frame: int) -> tuple[int, int, int]:
        """Publish what else is known of each slope; by the thread that holds the streams.

        Returns
        -------
        invalid, limited, iterations : int
            Sub-apertures without a slope, those whose denoising ended at the iteration limit, and how many
            iterations all took together.
        """
        with self._details.write_view_locked(frame_id=frame) as table:
            self._fill(
                slopes.flux,
                slopes.flags,
                slopes.iterations,
                slopes.standard_error_x,
                slopes.standard_error_y,
                self._counts,
                table,
            )
        invalid, limited, iterations = self._counts.tolist()
        return invalid, limited, iterations

    def publish_marks(self, marks: tuple[int, ...]) -> None:
        """Publish with what and when a frame was measured; by the thread that holds the streams."""
        with self._marks.write_view_locked(frame_id=marks[0]) as row:
            row[:] = marks

    def close(self) -> None:
        """Remove all streams."""
        for stream in (self._slopes, self._details, self._marks):
            stream.unlink()


def _created(name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> Any:
    """Create a stream; one whose writer has died is replaced."""
    try:
        import pyshmem
    except ImportError:
        raise MissingExtraError("pyshmem", "realtime", "publishing slopes in shared memory") from None
    # A living writer holds the stream's lock for good, which making one anew would wait for: so look first.
    try:
        old = pyshmem.open(name)
    except FileNotFoundError:
        return pyshmem.create(name, shape=shape, dtype=dtype)
    alive = old.producer_alive()
    old.close()
    if alive:
        raise InputError(
            f"{name}: a living process publishes under this name; stop it or choose another --name"
        )
    pyshmem.unlink(name)
    return pyshmem.create(name, shape=shape, dtype=dtype)
