"""Learning from the telemetry of a running engine, in a process of lowest priority beside it."""

import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.engine.engine import Engine
from faintspot.engine.processes.child_processes import ONE_THREAD, ChildProcesses, low_priority
from faintspot.engine.processes.requests import LENGTHY_TIMEOUT_S, request, socket_path
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io.telemetry import CLOSED_LOOP, Telemetry, stored_names
from faintspot.loop.control.base import KALMAN
from faintspot.loop.control.configuration import Control, load_control, prior_std_px
from faintspot.loop.control.identification.open_loop import known_delay, open_loop_of
from faintspot.loop.control.relearning import FEWEST_FRAMES, RelearntControl, relearn
from faintspot.loop.telemetry.recording import recorded_loop, site_of
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.pipeline.settings import Settings

_LOOK_S = 0.5  # between two looks at the telemetry, of which the ring keeps some seconds
_PATIENCE_S = 300.0  # processor time after which learning ends the process
_WATCH_S = 1.0
_FROM_NOTHING_EVERY = 6  # learnings, as a search from known layers finds no new one


class BackgroundLearning:
    """Learner of a running engine's Kalman filter from its telemetry, in another process than the engine.

    Parameters
    ----------
    name : str
        Name of the engine.
    config : path
        Configuration of the engine.
    every_s : float
        Seconds of telemetry, with a closed loop, for each learning; at least `FEWEST_FRAMES` frames.

    Raises
    ------
    InputError
        When the configuration has no Kalman filter or no size of a sub-aperture, or there is no engine.
    """

    def __init__(self, name: str, config: str | Path, every_s: float) -> None:
        described = Configuration(config)
        control = load_control(described)
        if control is None or control.options.controller != KALMAN:
            raise InputError(f'{config}: expected controller = "kalman" in [control], to learn it again')
        self._control: Control = control
        self._site, self._layout = site_of(described.layout), described.layout
        self._path, self._reader = socket_path(name), TelemetryRing.attach(name)
        self._every_s = every_s
        self._cursor, self._records = self._reader.records.written, list[NDArray[np.void]]()
        self._last: RelearntControl | None = None
        self._count = 0

    def take(self) -> bool:
        """Take the records that have come; return whether they are enough to learn from."""
        records, self._cursor, dropped = self._reader.records.since(self._cursor)
        closed = records["loop"] == CLOSED_LOOP
        if dropped or not closed.all():
            self._records.clear()
        elif len(records):
            self._records.append(records)
        while len(self._records) > 1 and self._are_enough(2):  # learning took long
            del self._records[0]
        return self._are_enough(1)

    def _are_enough(self, times: int) -> bool:
        """Return whether the records that wait are enough for a number of learnings."""
        frames = sum(map(len, self._records))
        return self._seconds >= times * self._every_s and frames >= times * FEWEST_FRAMES

    @property
    def _seconds(self) -> float:
        """Length of the records that wait."""
        if not self._records:
            return 0.0
        first, last = (self._records[end]["last_row_time_ns"][end] for end in (0, -1))
        return (int(last) - int(first)) / 1e9

    def run(self, say: Callable[[str], None]) -> None:
        """Learn at the lowest priority until the engine ends; `say` takes a line for each time."""
        low_priority()
        try:
            while not self._reader.stale:
                time.sleep(_LOOK_S)
                if self.take():
                    say(self._learnt_in_time())
        finally:
            self.close()

    def close(self) -> None:
        """Close the telemetry."""
        self._reader.close()

    def _learnt_in_time(self) -> str:
        signal.setitimer(signal.ITIMER_PROF, _PATIENCE_S)  # processor time: it may wait for long
        try:
            relearnt, is_taken = self.learn()
            return f"{relearnt.summary()}; {'taken' if is_taken else 'not taken'}"
        except InputError as error:
            return f"not learnt: {error}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)

    def learn(self) -> tuple[RelearntControl, bool]:
        """Learn from the records since the last time; return the result and whether the engine took it.

        Raises
        ------
        InputError
            When the frames cannot be learnt from, or the engine does not answer.
        """
        records, self._records = np.concatenate(self._records), []
        if len(np.unique(records["method"])) > 1:
            raise InputError("telemetry: expected frames of a single method, got interleaved ones")
        arrays = {field: records[field] for field in stored_names(records.dtype)}
        images: dict[str, Any] = dict.fromkeys(("image_frame", "raw", "denoised"), np.zeros(0))
        recording = Telemetry(**arrays, **images, changes=[], attributes=dict(self._reader.description))
        loop = recorded_loop(recording, self._control, self._layout, self._prior_std_px())
        _, delay, unknown = known_delay(loop)
        if unknown:
            delay = replace(delay, gain=self._control.model.centroid_gain)
        start = None
        if self._last is not None and self._count % _FROM_NOTHING_EVERY:
            start = self._last.learnt.identified
        self._last = relearnt = relearn(
            self._control.plant,
            self._control.model,
            open_loop_of(loop, delay).telemetry,
            self._site,
            loop.frame_rate_hz,
            start,
            None if unknown else delay,
        )
        self._count += 1
        with tempfile.TemporaryDirectory(prefix="faintspot-models-") as folder:
            model = f"{folder}/model.npz" if relearnt.is_better else None
            if model is not None:
                relearnt.learnt.save(model)
            found = relearnt.summary()
            request(self._path, "learnt", timeout_s=LENGTHY_TIMEOUT_S, model=model, found=found)
        if relearnt.is_better:
            self._control = self._control.with_model(relearnt.learnt)
        return relearnt, relearnt.is_better

    def _prior_std_px(self) -> NDArray[np.float64] | None:
        """Return the prior of the engine's present estimator; None without one."""
        values = request(self._path, "get")["settings"]
        stated = {name: value for name, value in values.items() if value is not None}
        return prior_std_px(Settings(stated.pop("estimator"), **stated), self._layout)


@contextmanager
def background_learning(
    engine: Engine, config: str | Path, every_s: float, say: Callable[[str], None]
) -> Iterator[None]:
    """Run the process that learns for an engine within a context; `say` takes a line if it ends."""

    def fault(text: str) -> None:
        engine.learning = {"fault": text}
        say(f"winds are not learnt again, the loop goes on: {text}")

    arguments = engine.name, f"{config}", f"{every_s}"
    done = threading.Event()
    with (
        tempfile.TemporaryDirectory(prefix="faintspot-learn-") as folder,
        ChildProcesses(Path(folder)) as children,
    ):
        children.start("learn", arguments, ONE_THREAD, "faintspot.engine.background")
        watcher = threading.Thread(target=_watch, args=(children, done, fault), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()


def _watch(children: ChildProcesses, done: threading.Event, on_fault: Callable[[str], None]) -> None:
    """Wait for the end of the process."""
    while not done.wait(_WATCH_S):
        try:
            children.check()
        except InputError as error:
            if not done.wait(_WATCH_S):  # else the engine has ended, too
                on_fault(f"{error}")
            return


if __name__ == "__main__":
    engine_name, configuration, seconds = sys.argv[1:]
    try:
        BackgroundLearning(engine_name, configuration, float(seconds)).run(print)
    except InputError as fault:
        sys.exit(f"{fault}")
