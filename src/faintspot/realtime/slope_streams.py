"""Slopes out: streams of pyshmem, which pyRTC and, through its bridge, ImageStreamIO read."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack

import numpy as np

from faintspot.kernels.compiling import Direct
from faintspot.kernels.telemetry_rows import fill_telemetry_rows
from faintspot.realtime.shared_streams import create_stream, held
from faintspot.slopes import Slopes

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
        When a living process publishes under that name, another user has taken it, or shared memory is short.
    """

    def __init__(self, name: str, n: int) -> None:
        with ExitStack() as undo:
            self._slopes = create_stream(f"{name}_slopes", (2 * n,))
            undo.callback(self._slopes.unlink)
            self._details = create_stream(f"{name}_details", (len(DETAILS), n))
            undo.callback(self._details.unlink)
            self._marks = create_stream(f"{name}_marks", (len(MARKS),), np.int64)
            undo.pop_all()
        self._n = n
        self._fill = Direct(fill_telemetry_rows)
        self._counts = np.zeros(3, np.int64)

    def held(self) -> AbstractContextManager[None]:
        """Keep the streams' locks while publishing; see `shared_streams.held`."""
        return held(self._slopes, self._details, self._marks)

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
