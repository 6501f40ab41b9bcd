"""An engine that runs in a thread of the test, a camera that the test plays, and what is published."""

import threading
from collections.abc import Iterable
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray
from tests.patience import LIMIT_S, wait_for

import faintspot as fs
from faintspot.base.files import Closing
from faintspot.engine.engine import Engine
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.settings.plan import EngineOptions
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.slopes.simulate import sensor_frames

LAYOUT = fs.Layout.grid((4, 4), pixels=8)
CALIBRATION = fs.Calibration(100.0, read_noise_e=1.0)
SETTINGS = fs.Settings(noise_std=1.0, keep_brightest=9)


def make(settings: fs.Settings) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, settings, CALIBRATION)


def simulated(n: int) -> NDArray[np.uint16]:
    detector = fs.slopes.simulate.Detector(1.0, offset_adu=100.0, bits=16)
    frames, _ = sensor_frames(LAYOUT, n, flux_e=300.0, detector=detector, rng=np.random.default_rng(8))
    return np.asarray(frames, np.uint16)


def split(options: dict[str, Any], **others: Any) -> tuple[EngineOptions]:
    """Take the options of `EngineOptions` out of those of an engine."""
    names = options.keys() & EngineOptions.__dataclass_fields__.keys()
    return (EngineOptions(**others, **{name: options.pop(name) for name in names}),)


class Bench(Closing):
    """Every frame that the engine measures is in `records`, in the order in which it was measured."""

    def __init__(self, name: str | None = None, **options: Any) -> None:
        self.name = name or f"fs_test_{uuid4().hex[:12]}"
        self._ring: PixelRing | None = None
        self.engine = Engine(self.name, make, SETTINGS, *split(options), **options)
        self._thread = threading.Thread(target=self.engine.run)
        self.telemetry = TelemetryRing.attach(self.name)
        self._thread.start()

    def ring(self, dtype: Any = np.uint16, shape: tuple[int, int] = LAYOUT.frame_shape) -> PixelRing:
        self._ring = PixelRing.create(self.name, shape, dtype)
        return self._ring

    def until(self, condition: Any) -> None:
        wait_for(condition, self.engine.status)

    def attached(self) -> None:
        self.until(lambda: self.engine._waiting)

    def detached(self) -> None:
        self.until(lambda: self.engine.preparer.ring is None)

    def send(self, ring: PixelRing, number: int, frame: NDArray[Any], rows: int = 5) -> None:
        """Send a frame row by row, and wait until it has been measured."""
        before = self.engine.counters.frames_in
        slot = ring.begin(number)
        for row in range(0, len(frame), rows):
            slot[row : row + rows] = frame[row : row + rows]
            ring.rows_ready(min(row + rows, len(frame)))
        ring.end()
        self.until(lambda: self.engine.counters.frames_in > before)

    def measure(self, frames: NDArray[Any], numbers: Iterable[int] | None = None) -> None:
        """Send frames one after another through a ring of their own."""
        with self.ring(frames.dtype) as ring:
            self.attached()
            for number, frame in zip(numbers or range(len(frames)), frames, strict=True):
                self.send(ring, number, frame)

    @property
    def records(self) -> NDArray[Any]:
        return self.telemetry.records.since(0)[0]

    @property
    def slopes(self) -> dict[int, NDArray[np.float32]]:
        """Of every frame number, as measured last."""
        return {int(each["frame"]): np.concatenate([each["x"], each["y"]]) for each in self.records}

    def close(self) -> None:
        self.engine.stop()
        self._thread.join(LIMIT_S)
        if self._ring is not None:
            self._ring.close()
        assert not self._thread.is_alive()
