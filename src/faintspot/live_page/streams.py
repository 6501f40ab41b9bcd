"""The newest values of a pyshmem stream that may be missing or recreated."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.live_page.batch import Floats
from faintspot.realtime.shared_streams import lock_file, pyshmem_module

_LOOK_S = 1.0  # between two checks whether the stream exists and is the same
_READ_S = 1e-3  # to wait for a writer in the middle of a publication


class NewestOfStream:
    """Newest values of a stream of real numbers; an unreadable stream is treated as missing.

    Parameters
    ----------
    name : str
        Name of the stream, which need not exist.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._pyshmem = pyshmem_module("reading streams in shared memory")
        self._stream: Any = None
        self._next_look_s = 0.0
        self._seen = 0

    def take(self) -> tuple[int, Floats] | None:
        """Return frame number and values if they are new, else None."""
        if time.monotonic() >= self._next_look_s:
            self._next_look_s = time.monotonic() + _LOOK_S
            self._look()
        stream = self._stream
        if stream is None or stream.count == self._seen:
            return None
        try:
            publication = stream.read_publication(timeout=_READ_S)
        except (OSError, ValueError, RuntimeError):  # usually incomplete
            return None
        self._seen = publication.count
        return int(publication.frame_id), np.asarray(publication.payload, np.float64).ravel()

    def close(self) -> None:
        """Close the stream."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _look(self) -> None:
        """Open the stream if it exists, and close one that was removed or recreated."""
        try:
            if self._stream is not None:
                if self._pyshmem.stat(self.name)["instance_id"] == self._stream.instance_id:
                    return
                self.close()
            lock_file(self.name)  # refuse a folder that is not private
            stream = self._pyshmem.open(self.name, gpu_device=False)
        except (OSError, ValueError, InputError):
            self.close()
            return
        if np.dtype(stream.dtype).kind not in "iuf":
            stream.close()
            return
        self._stream, self._seen = stream, 0
