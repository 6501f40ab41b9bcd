"""The engine: frames come in by rows, slopes go out, settings change in between."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.flags import SubapertureFlag
from faintspot.pipeline import SlopePipeline
from faintspot.realtime.frame_path import FramePath, Progress, check_light_is_known
from faintspot.realtime.live import LiveSettings
from faintspot.realtime.outputs import SlopeStreams
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.pixel_segment import FRAME, ROWS
from faintspot.realtime.timing import Counters, Latencies
from faintspot.sensor.settings import Settings

_WATCH_S = 0.02  # between two looks of the watcher
_LOOKS_BETWEEN_STALE = 10  # asking the operating system whether the source lives takes longer


class Engine:
    """Measures the frames of a pixel ring and publishes their slopes, until it is told to stop.

    Parameters
    ----------
    name : str
        Of the pixel ring, and of the streams of slopes.
    make_pipeline : function
        Makes a pipeline from settings.
    settings : Settings
        To begin with.
    threads : int
        Workers.

    Raises
    ------
    InputError
        When the settings do not fit, or somebody else publishes under that name.
    """

    def __init__(
        self,
        name: str,
        make_pipeline: Callable[[Settings], SlopePipeline],
        settings: Settings,
        *,
        threads: int = 1,
    ) -> None:
        self.name, self._threads = name, threads
        self.counters, self.latencies = Counters(), Latencies()
        self.refused: list[str] = []
        """What of the real-time manners was not permitted."""
        self._ring: PixelRing | None = None
        self._paths: WeakKeyDictionary[SlopePipeline, tuple[PixelRing, FramePath]] = WeakKeyDictionary()
        self._running: FramePath | None = None
        self._waiting_for = -1
        self._stopping = threading.Event()
        self._make_pipeline = make_pipeline
        self.live = LiveSettings(self._made, settings)
        self._streams = SlopeStreams(name, len(self.live.pipeline.layout))

    # Any thread -------------------------------------------------------------------------------------

    def stop(self) -> None:
        """End the run after the frame that is being measured; from any thread."""
        self._stopping.set()

    def status(self) -> dict[str, Any]:
        """Return counters and latencies as plain values."""
        ring = self._ring
        return {
            "name": self.name,
            "source": None if ring is None else {"pid": ring.creator_pid, "frame": ring.progress()[0]},
            "counters": self.counters.as_dict(),
            "latency": self.latencies.as_dict(),
            "estimator": self.live.settings.estimator,
            "not_permitted": list(self.refused),
        }

    # The engine's thread ----------------------------------------------------------------------------

    def run(self, n_frames: int | None = None) -> None:
        """Measure frames until `stop`, or so many; wait for the source where there is none."""
        watcher = threading.Thread(target=self._watch, name="faintspot-watcher", daemon=True)
        watcher.start()
        try:
            with self._streams.held():
                while not self._done(n_frames):
                    ring = self._attached()
                    if ring is None:
                        self._stopping.wait(_WATCH_S)
                        continue
                    self._ring = ring
                    self._follow(ring, n_frames)
                    self._ring = None
        finally:
            self._stopping.set()
            watcher.join()
            self._streams.close()

    def _done(self, n_frames: int | None) -> bool:
        return self._stopping.is_set() or (n_frames is not None and self.counters.processed >= n_frames)

    def _attached(self) -> PixelRing | None:
        """Return the source's ring, None where there is none that lives and fits."""
        try:
            ring = PixelRing.attach(self.name)
        except InputError:
            return None
        fits = ring.shape == self.live.pipeline.layout.frame_shape and ring.dtype in (np.uint16, np.float32)
        return ring if fits and not (ring.stale or ring.closed) else None

    def _follow(self, ring: PixelRing, n_frames: int | None) -> None:
        """Measure the frames of a ring until it ends."""
        self._path(ring, -1)  # made before the first frame is waited for
        frame = ring.progress()[0] + 1
        first_is_known = frame > 0  # a source may begin with any number
        while not self._done(n_frames):
            path = self._path(ring, frame)
            self._running, self._waiting_for = path, frame
            whole = path.measure(frame)
            self._waiting_for = -1
            if not whole:
                if self._stopping.is_set() or ring.closed or ring.stale:
                    self.counters.source_restarts += not self._stopping.is_set()
                    return
                path.go_on()
                frame = ring.progress()[0] + 1  # the source has begun to count anew
                self.counters.repeated += 1
                continue
            if not first_is_known and not ring.intact(frame):
                frame = ring.progress()[0]
            else:
                frame = self._published(ring, path, frame)
            first_is_known = True

    def _path(self, ring: PixelRing, frame: int) -> FramePath:
        """Return the way of the next frame; changes of settings take effect here.

        It was made when they were proposed, unless that was for another ring.
        """
        pipeline = self.live.take(frame)
        made_for, path = self._paths.get(pipeline, (None, None))
        if path is None or made_for is not ring:
            path = self._new_path(pipeline, ring)
            self._paths[pipeline] = ring, path
        if self._running is not None and path is not self._running:
            self.counters.settings_changes += self._running.pipeline is not pipeline
        return path

    def _published(self, ring: PixelRing, path: FramePath, frame: int) -> int:
        """Publish what was measured, unless it was not that frame; return the next one to wait for."""
        moment = ring.last_row_time_ns(frame)
        if moment and ring.intact(frame):
            self._streams.publish_slopes(path.slopes, frame)
            self.latencies.add(time.monotonic_ns() - moment)
            self._streams.publish_details(path.slopes, frame)
            self._count(path)
            return frame + 1
        self.counters.frames_in += 1
        newest = ring.progress()[0]
        if newest - frame >= ring.slots - 1:  # overtaken: go on with the newest
            self.counters.torn += 1
            self.counters.dropped += newest - frame
            return newest
        self.counters.skipped += 1  # the source left out this number, or did not end the frame
        return frame + 1

    def _count(self, path: FramePath) -> None:
        """Count what was published."""
        slopes, counters = path.slopes, self.counters
        counters.frames_in += 1
        counters.processed += 1
        counters.invalid_subapertures += len(slopes.x) - int(np.count_nonzero(slopes.valid))
        limited = slopes.flags & SubapertureFlag.NOT_CONVERGED
        counters.at_iteration_limit += int(np.count_nonzero(limited))

    # Making paths -----------------------------------------------------------------------------------

    def _made(self, settings: Settings) -> SlopePipeline:
        """Make a pipeline, and where there is a source its way for frames, complete and warm."""
        pipeline = self._make_pipeline(settings)
        check_light_is_known(pipeline)
        ring = self._ring
        if ring is not None:
            self._paths[pipeline] = ring, self._new_path(pipeline, ring)
        return pipeline

    def _new_path(self, pipeline: SlopePipeline, ring: PixelRing) -> FramePath:
        cells, pixels = writable_view(ring.cells), writable_view(ring.pixels)
        columns = ring.cells.shape[1]
        path = FramePath(
            pipeline, pixels, Progress(cells, FRAME * columns, ROWS * columns), threads=self._threads
        )
        path.warm_up()
        return path

    # The watcher's thread ---------------------------------------------------------------------------

    def _watch(self) -> None:
        """End the engine's waiting when it is to stop, or when what it waits for will not come."""
        looks = 0
        while True:
            stopping = self._stopping.wait(_WATCH_S)
            looks += 1
            ring, path, frame = self._ring, self._running, self._waiting_for
            if ring is not None and path is not None and frame >= 0:
                gone = ring.closed or (looks % _LOOKS_BETWEEN_STALE == 0 and ring.stale)
                # The frame before the one that is waited for has been there: numbers have begun anew.
                anew = ring.progress()[0] < frame - 1
                if stopping or gone or anew:
                    path.stop()
            if stopping and (frame < 0 or ring is None):
                return


def writable_view(array: NDArray[Any]) -> NDArray[Any]:
    """Return the same memory as an array of the kind that kernels are compiled for, which may be written to.

    Nobody writes: it spares compiling every kernel once more for memory that is read-only.
    """

    class _Memory:
        __array_interface__ = {  # noqa: RUF012 (what NumPy looks for)
            **array.__array_interface__,
            "data": (array.__array_interface__["data"][0], False),
        }
        owner = array

    return np.asarray(_Memory())
