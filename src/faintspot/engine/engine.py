"""The engine: read frames row by row, publish slopes, and change settings between frames."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.engine.control.control_loop import CLOSED, OPEN, STATES, ControlLoop
from faintspot.engine.frames.frame_path import FramePath
from faintspot.engine.frames.pixel_ring import PixelRing, living_ring
from faintspot.engine.frames.timing import INCOMPLETE, WORKER, FrameAccount
from faintspot.engine.frames.workers import SlopePrior, Workers
from faintspot.engine.settings import plan
from faintspot.engine.settings.estimators import EngineEstimators
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.engine.settings.running_settings import Change, RunningSettings
from faintspot.engine.streams.slope_streams import PredictionStream, SlopeStreams
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.loop.control.configuration import Control, packed_control
from faintspot.loop.control.options import NONE, STREAM
from faintspot.slopes.pipeline.configuration import to_text
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

if TYPE_CHECKING:
    from faintspot.engine.streams.bridge import StreamBridge

_WATCH_S = 0.02  # between two checks of the watcher
_LOOKS_BETWEEN_SLOW = 10  # ditto, between two of those that take longer


class Engine:
    """Real-time engine: measures the frames of a pixel ring and publishes slopes and commands until stopped.

    Parameters
    ----------
    name : str
        Name of the pixel ring and of the streams of slopes.
    make_pipeline : function
        Function that makes a pipeline from settings.
    settings : Settings
        Initial settings.
    options : EngineOptions, optional
    interleaving : Interleaving, optional
        Configurations that take turns: changes of the settings, and controllers.
    source : StreamBridge, optional
        Brings frames into the ring in the thread that measures them. Default: another process writes into the
        ring.
    control : Control, optional
        Computes commands from slopes; the loop starts open. Default: no commands. The reference slopes are
        for the pipelines.

    Attributes
    ----------
    loop : ControlLoop or None

    Raises
    ------
    InputError
        When the settings do not fit, or another process publishes under that name.
    """

    def __init__(
        self,
        name: str,
        make_pipeline: Callable[[Settings], SlopePipeline],
        settings: Settings,
        options: plan.EngineOptions | None = None,
        *,
        interleaving: Interleaving | None = None,
        source: StreamBridge | None = None,
        control: Control | None = None,
    ) -> None:
        options = plan.EngineOptions() if options is None else options
        threads = options.threads
        self.name, self._images_every = name, options.images_every
        interleaving = Interleaving() if interleaving is None else interleaving
        self.account = FrameAccount(options.deadline_s)
        self.counters = self.account.counters
        self.refused: list[str] = []
        """Parts of the real-time scheduling that were not permitted."""
        self.learning: dict[str, Any] | None = None
        """Result of the latest learning beside the engine, or the fault that ended it, for the status."""
        self._source, self._incompatible = source, ""
        self._path: FramePath | None = None
        self._waiting = False
        self._arrival, self._number = 0, -1  # of the last measured frame
        # Frames of an own source are complete when they are measured: there is nothing to sleep for.
        self._sleeps, self._last_row_ns = source is None and not options.polls, 0
        self._measured = Counter[int]()  # frames, by configuration
        self._stopping = threading.Event()
        self._workers = Workers(threads - 1, options.cpus) if threads > 1 else None
        prior = None if control is None else SlopePrior(len(control.interaction) // 2)
        self.preparer = plan.SettingsPreparer(
            make_pipeline, interleaving, self._workers, options.deadline_s, prior
        )
        self.live: RunningSettings[plan.EnginePlan] = RunningSettings(self.preparer.prepare, settings)
        self.estimators = EngineEstimators(self.live, self.preparer)
        mean_flux = options.mean_flux
        self._flux = None if mean_flux is None else plan.FluxFollower(self.live, mean_flux)
        first, layout = self.live.running.pipelines[0], self.live.running.layout
        self._dark = plan.DarkFollower(first)
        self._raw = np.zeros(layout.frame_shape, np.float32)
        if control is not None and prior is not None:
            control.check_fits(len(layout))
            control.check_errors(first.calibration)
            prior.largest_px = max(layout.frame_shape)
        commands = 0 if control is None else control.commands
        self._streams = SlopeStreams(name, len(layout), commands)
        with ExitStack() as resources:
            resources.callback(self._streams.close)
            self.loop = self._prediction = None
            if control is not None and prior is not None:
                is_streamed = control.prediction == STREAM
                loop_prior = None if is_streamed else prior
                self.loop = ControlLoop(control, layout, self._streams.held_commands, loop_prior, threads)
                self._prediction = PredictionStream(name, prior) if is_streamed else None
            self._make_ready(interleaving)
            self._telemetry = TelemetryRing.create(
                name,
                layout,
                settings=to_text(settings),
                methods=interleaving.labels,
                commands=commands,
                reference=None if control is None else control.reference,
                control=packed_control(control),
            )
            for part in (self._telemetry, source, self._workers, self._prediction, self._flux):
                if part is not None:
                    resources.callback(part.close)
            self._resources = resources.pop_all()
            """Closed in reverse order when the engine has run."""

    # Any thread -------------------------------------------------------------------------------------

    def stop(self) -> None:
        """End the run after the present frame; callable from any thread."""
        self._stopping.set()

    def status(self) -> dict[str, Any]:
        """Return counters and latencies as plain values."""
        ring, interleaving = self.preparer.ring, self.live.running.interleaving
        return {
            "name": self.name,
            "source": None if ring is None else {"pid": ring.creator_pid, "frame": ring.progress()[0]},
            "source_refused": self._incompatible or None,
            "preparing": self.live.preparing,
            **self.account.as_dict(),
            "estimator": self.live.settings.estimator.name,
            "subapertures": len(self.live.running.layout),
            "dark": np.flatnonzero(self._dark.dark).tolist(),
            "methods": interleaving.labels,
            "every": interleaving.every,
            "loaded": {name: str(file.path) for name, file in self.estimators.loaded.items()},
            "estimator_fault": self.estimators.fault,
            "not_permitted": list(self.refused),
            "loop": self.loop_status(),
            "learning": self.learning,
            "prediction": None if self._prediction is None else self._prediction.status(),
        }

    def loop_status(self) -> dict[str, object]:
        """Return the state of the loop as plain values."""
        if self.loop is None:
            return {"state": NONE}
        return {**self.loop.status(), "obstacle": self._streams.commands_obstacle()}

    def interleave(self, text: str, every: int) -> Change:
        """Replace the configurations that take turns; see `Interleaving.parse`. For one thread at a time.

        Raises
        ------
        InputError
            When the text is refused; nothing changes then.
        """
        before = self.preparer.interleaving
        new = Interleaving.parse(text, every, before.first + len(before.methods))
        self._make_ready(new)
        with self.preparer.kept_if_right():
            self.preparer.interleaving = new
            return self.live.renew(new.as_change)

    def _make_ready(self, interleaving: Interleaving) -> None:
        """Prepare the controllers of all configurations, or refuse them."""
        for method in interleaving.methods:
            if method.control is None:
                continue
            try:
                if self.loop is None:
                    raise InputError("this engine makes no commands; add [control] to its configuration")
                self.loop.control.check_errors(self.live.running.pipelines[0].calibration, method.control)
                self.loop.make_ready(method.control)
            except InputError as error:
                raise InputError(f"interleave: {method.label!r}: {error}") from None

    # The engine's thread ----------------------------------------------------------------------------

    def run(self, n_frames: int | None = None) -> None:
        """Measure frames until `stop` or for `n_frames`; wait while there is no source."""
        watcher = threading.Thread(target=self._watch, name="faintspot-watcher", daemon=True)
        watcher.start()
        if self._flux is not None:
            self._flux.start()
        waited = False
        try:
            with self._streams.held(), np.errstate(all="ignore"):  # a warning takes time and is not shown
                while not self._done(n_frames):
                    ring, self._incompatible = living_ring(self.name, self.live.running.layout.frame_shape)
                    if ring is None:
                        self._await_ring()
                    else:
                        # All frames of a ring that was waited for count; else only those from now on.
                        self._arrival, self._number = (
                            (0, -1) if waited else (ring.arrivals, ring.progress()[0])
                        )
                        self.preparer.ring = ring
                        try:
                            self._follow(ring, n_frames)
                        finally:
                            ring.unfollow()
                        self.preparer.ring = None
                    waited = True
        finally:
            self._stopping.set()
            watcher.join()
            self._resources.close()

    def _done(self, n_frames: int | None) -> bool:
        return self._stopping.is_set() or (n_frames is not None and self.counters.processed >= n_frames)

    def _await_ring(self) -> None:
        """Wait a moment for the source to make a ring."""
        if self._source is None:
            self._stopping.wait(_WATCH_S)
        else:
            self._source.step()

    def _follow(self, ring: PixelRing, n_frames: int | None) -> None:
        """Measure the frames of a ring until it ends."""
        self._take(ring)  # prepared before waiting for the first frame
        lost_before = self.counters.dropped
        ring.follow(self._arrival)
        if self._workers is not None:
            self._workers.wake()
        while not self._done(n_frames):
            # Frames in the ring come first: otherwise every later frame would wait for its successor.
            behind = ring.arrivals > self._arrival
            if self._source is not None and not behind and not self._source.step():
                if ring.closed:
                    self.counters.source_restarts += 1
                    break
            elif not self._measure_next(ring):
                if self._stopping.is_set() or ring.closed or ring.stale:
                    self.counters.source_restarts += not self._stopping.is_set()
                    break
                if self._path is not None:
                    self._path.go_on()
            ring.follow(self._arrival, self.counters.dropped - lost_before)
        if self._workers is not None:
            self._workers.park()

    def _measure_next(self, ring: PixelRing) -> bool:
        """Measure and publish the next frame; return False when the wait for it was ended."""
        path, method = self._take(ring)
        path.set_dark(self._dark.dark, self._dark.changes)
        self._path, self._waiting = path, True
        arrival = self._arrival + 1
        explain = self._images_every > 0 and self._measured[method] % self._images_every == 0
        if self._prediction is not None:
            path.await_start(arrival, self._last_row_ns)
            self._prediction.fill(self._number + 1)
        slot, last_row = (self._number + 1) % ring.slots, self._last_row_ns
        product = () if self.loop is None else self.loop.begin_product()
        rehearse = self._rehearse if last_row else None
        is_whole = path.measure(
            arrival, slot, explain=explain, after_ns=last_row, rehearse=rehearse, product=product
        )
        number = ring.number_of(arrival)
        if is_whole and number >= 0 and number != self._number + 1:  # it is in another slot than expected
            is_whole = path.measure(arrival, number % ring.slots, explain=explain, product=product)
        self._waiting = False
        if not is_whole and path.stopped:
            return False
        self._end_frame(ring, path, method, arrival, number if is_whole else -1, explain)
        return True

    def _rehearse(self) -> None:
        """Do what comes between a frame's last row and its slopes, without effect."""
        ring, number = self.preparer.ring, self._number
        if ring is not None and self._path is not None:
            ring.last_row_time_ns(ring.number_of(self._arrival), self._arrival)
            self._streams.rehearse(self._path.slopes, number)
            time.monotonic_ns()

    def _take(self, ring: PixelRing) -> tuple[FramePath, int]:
        """Return the next frame's path and configuration; changes of settings take effect here."""
        prepared = self.live.take(self._number + 1)
        index = prepared.interleaving.method_of(self.counters.processed)
        path = prepared.paths(ring)[index]
        if path.fault is not None and prepared.fallback is not None:
            self.estimators.fall_back(prepared.fallback, path.fault)
            return self._take(ring)
        if self.loop is not None:
            self.loop.take_turn(prepared.interleaving.methods[index].control)
        return path, prepared.interleaving.first + index

    def _end_frame(
        self, ring: PixelRing, path: FramePath, method: int, arrival: int, number: int, explained: bool
    ) -> None:
        """Publish the slopes first, then the details, unless the frame was overwritten meanwhile."""
        slopes = path.slopes
        moment = ring.last_row_time_ns(number, arrival) if number >= 0 else 0
        if not moment:
            self._lose(ring, path, arrival, number)
            return
        path.locate()
        self._streams.publish_slopes(slopes, number)
        published = time.monotonic_ns()
        loop, state, commands = self.loop, 0, None
        if loop is not None:
            was_closed = loop.closed
            commands = loop.follow(slopes, number, path.prior_std_px)
            self._streams.publish_commands(commands, number)
            loop.latencies.add(time.monotonic_ns() - moment)
            state = STATES.index(CLOSED if was_closed else OPEN)
            loop.look_after(slopes.flux)
        path.flag_doubtful()
        change = self.live.change_number
        self._streams.publish_marks((number, method, change, moment, published))
        details = self._streams.publish_details(slopes, number)
        causes = self.account.published(published - moment, path, preparing=self.live.preparing is not None)
        self._telemetry.write(
            number, method, change, (moment, published), slopes, causes=causes, loop=state, commands=commands
        )
        self._dark.take(path.frame)
        if self._flux is not None:
            self._flux.take(slopes.flux)
        if self._streams.commands_lost:
            self.counters.commands_renewed += self._streams.renew_commands()
        if explained:
            np.copyto(self._raw, ring.slot(number))
            if ring.intact(number, arrival):
                self._telemetry.write_images(number, self._raw, path.denoised)
        self.account.finished(details, number, self._number if self._arrival else None)
        self._measured[method] += 1
        self._arrival, self._number = arrival, number
        self._last_row_ns = moment if self._sleeps else 0

    def _lose(self, ring: PixelRing, path: FramePath, arrival: int, number: int) -> None:
        """Count a frame that cannot be published, and find the next one."""
        cause, passed_over = None, 0
        self._last_row_ns = 0
        if number >= 0 and ring.intact(number, arrival):  # the next one began before its last row arrived
            self.counters.short += 1
            self._number, cause = number, INCOMPLETE
        elif ring.number_of(arrival) >= 0:  # complete, but a worker died and its share is missing
            self._number, cause = ring.number_of(arrival), WORKER
        else:  # overwritten: continue with the newest frame
            newest = ring.arrivals
            passed_over = max(newest - 1 - arrival, 0)
            self.counters.torn += 1
            self.counters.passed_over += passed_over
            self._number = ring.number_of(newest) - 1
        self._arrival = arrival + passed_over
        self.account.lost(1 + passed_over, path, preparing=self.live.preparing is not None, cause=cause)

    # The watcher's thread ---------------------------------------------------------------------------

    def _watch(self) -> None:
        """End the engine's waiting when it is to stop or its source has gone.

        Also do all that takes time: write changes to telemetry, replace dead workers, check streams.
        """
        last_change, loop_state = 0, dict[str, object]()
        for looks in count(1):
            stopping, is_slow = self._stopping.wait(_WATCH_S), looks % _LOOKS_BETWEEN_SLOW == 0
            ring, path = self.preparer.ring, self._path if self._waiting else None
            gone = ring is not None and (ring.closed or (is_slow and ring.stale))
            if ring is not None and path is not None and (stopping or gone):
                path.stop()
            if self._workers is not None:
                self.counters.worker_restarts += self._workers.replace_dead()
            self.live.let_go()
            if self._prediction is not None:
                self._prediction.look_after()
            if is_slow:
                self._dark.look()
                self._streams.look_after_commands()
            if self.loop is not None and (state := self.loop.noted_state()) != loop_state:
                self._telemetry.write_change(self._number, self.live.change_number, state, None)
                loop_state = state
            self.counters.settings_changes = self.live.change_number
            for change in self.live.taken(after=last_change):
                self._telemetry.write_change(*change)
                last_change = change[1]
            if stopping and (ring is None or not self._waiting):
                return
