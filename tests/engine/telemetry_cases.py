"""What the tests of telemetry write: every number tells its frame."""

import threading
from typing import Any, Self

import numpy as np

from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout

LAYOUT = Layout.grid((3, 3), pixels=8, inner_radius=0.5)
SETTINGS = '[estimator]\nname = "tv"\nnoise_std = 1.5\n'
N = len(LAYOUT)
NUMBERS = np.arange(N)
FIELDS = (
    *("x", "y", "flux", "flags", "iterations", "bad_pixels"),
    *("standard_error_x", "standard_error_y", "covariance_xy"),
)


def slopes_of(frame: int) -> Slopes:
    """Slopes whose numbers all tell the frame and what they are; flags below 256."""
    values = {
        name: (NUMBERS + frame * 8 + place) % (256 if name == "flags" else 1 << 20)
        for place, name in enumerate(FIELDS)
    }
    return Slopes(*(values[name].astype(kind) for name, kind in zip(FIELDS, RESULT_TYPES, strict=True)))


def write(ring: TelemetryRing, frame: int) -> None:
    """Write the record of a frame."""
    ring.write(frame, frame % 2, frame // 10, (10**6 * frame + 7, 10**6 * frame + 507), slopes_of(frame))


def write_images(ring: TelemetryRing, frame: int) -> None:
    """Write images that tell their frame."""
    raw = np.full(LAYOUT.frame_shape, frame, np.uint16)
    ring.write_images(frame, raw, np.full((N, *LAYOUT.window), frame + 0.5, np.float32))


def as_written(items: Any) -> bool:
    """Whether records (structured, or `Telemetry`) hold what `write` writes; none is torn."""
    frames = [int(frame) for frame in items["frame"]]
    right = [items["method"], items["change"], items["last_row_time_ns"], items["published_time_ns"]]
    expected = [[f % 2, f // 10, 10**6 * f + 7, 10**6 * f + 507] for f in frames]
    scalars = np.array_equal(np.stack(right, axis=-1), np.array(expected).reshape(-1, 4))
    names = [name for name in FIELDS if name != "bad_pixels"]
    return scalars and all(
        np.array_equal(items[name][i], getattr(slopes_of(frame), name))
        for i, frame in enumerate(frames)
        for name in names
    )


class Engine(threading.Thread):
    """Stands for an engine: writes a frame every millisecond, or as told, until it is stopped."""

    def __init__(self, ring: TelemetryRing, pause_s: float = 1e-3) -> None:
        super().__init__(daemon=True)
        self.ring, self.stopping, self.pause_s = ring, threading.Event(), pause_s
        self.frames = 0

    def run(self) -> None:
        """Write."""
        while not self.stopping.wait(self.pause_s):
            write(self.ring, self.frames)
            if self.frames % 10 == 0:
                write_images(self.ring, self.frames)
                self.ring.write_change(self.frames, self.frames // 10, {"noise_std": 2.5}, None)
            self.frames += 1

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End it and its telemetry."""
        self.stopping.set()
        self.join()
        self.ring.close()
