"""Data of a running engine, read from shared memory."""

from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.engine.page.page_state import Batch, Picture
from faintspot.engine.streams.stream import Follower
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.engine.telescope import TRUTH
from faintspot.slopes.sensor.layout import Layout

_TRUTH_FIELDS = tuple(TRUTH.index(name) for name in ("strehl", "rms_nm", "time_s"))


class EngineSource:
    """Telemetry of an engine, with the truth and commands if available.

    It waits for the engine to start, and to restart.

    Parameters
    ----------
    name : str
        Name of the engine.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.layout: Layout | None = None
        self.methods: list[str] = []
        self._reader: TelemetryRing | None = None
        self._truth, self._commands = Follower(f"{name}_truth"), Follower(f"{name}_commands")
        self._cursors = [0, 0, 0]  # records, images, changes
        self._camera_hz: float | None = None

    def read(self) -> Batch | None:
        """Return the data since the last call; None while there is no engine."""
        anew = self._reader is None and self._attached()
        reader = self._reader
        if reader is None:
            return None
        truth = self._newest_truth()
        # Images first: each image's record was written before it, so it is among these records or older ones.
        images, self._cursors[1], _ = reader.images.since(max(self._cursors[1], reader.images.written - 1))
        records, self._cursors[0], missed = reader.records.since(self._cursors[0])
        changes, self._cursors[2], _ = reader.changes_since(self._cursors[2])
        picture = None
        if len(images):
            newest = images[-1]
            picture = Picture(int(newest["image_frame"]), newest["raw"], newest["denoised"])
        if not len(records) and reader.stale:  # all of it has been read
            reader.close()
            self._reader = None
        commands = self._commands.newest()
        return Batch(
            records,
            missed,
            picture,
            truth=truth,
            commands=None if commands is None else commands.values.astype(np.float64),
            changes=changes,
            anew=anew,
        )

    def state(self) -> dict[str, Any]:
        """Return the engine's name, whether it is running, and the frame rate of a simulated camera."""
        is_running = self._reader is not None
        return {"name": self.name, "there": is_running, "camera_hz": self._camera_hz}

    def close(self) -> None:
        """Close the shared memory."""
        self._truth.close()
        self._commands.close()
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _attached(self) -> bool:
        """Look for the engine's telemetry; return whether it is available."""
        try:
            reader = TelemetryRing.attach(self.name)
        except InputError:
            return False
        if reader.stale:
            reader.close()
            return False
        self._reader, self.layout = reader, reader.layout
        self.methods = reader.description["methods"]
        self._cursors = [reader.records.written, max(0, reader.images.written - 1), 0]
        return True

    def _newest_truth(self) -> tuple[int, float, float] | None:
        truth = self._truth.newest()
        if truth is None or len(truth.values) != len(TRUTH):
            return None
        strehl, rms_nm, time_s = truth.values[list(_TRUTH_FIELDS)]
        self._camera_hz = round((truth.number + 0.5) / time_s, 3) if time_s > 0 else None
        return (truth.number, float(strehl), float(rms_nm)) if np.isfinite([strehl, rms_nm]).all() else None
