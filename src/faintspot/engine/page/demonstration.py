"""A simulated telescope, an engine that closes its loop and its page; with a comparison of methods."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.files import Closing, derived, output_errors, write_atomically
from faintspot.engine.control.control_loop import CLOSED, STATES
from faintspot.engine.processes.child_processes import ONE_THREAD, ChildProcesses
from faintspot.engine.processes.requests import TELESCOPE, ControlServer, request, socket_path
from faintspot.engine.request_handlers import while_starting
from faintspot.engine.settings.interleaving import short_names
from faintspot.engine.streams.stream import Follower
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.engine.telescope import TRUTH
from faintspot.loop.control.base import KALMAN
from faintspot.loop.control.configuration import save_control
from faintspot.loop.control.options import TABLE
from faintspot.loop.simulation.configuration import LoopConfiguration, load_loop
from faintspot.loop.simulation.engine_files import CONFIGURATION, fixed_window, write_engine_files
from faintspot.loop.telemetry.turns import MethodDifference, compared_methods
from faintspot.slopes.pipeline.configuration import Configuration, save
from faintspot.slopes.pipeline.settings import Settings

Say = Callable[[str], None]

_STAR = "camera_3e"
# Chosen in the simulated loop with other realisations of the turbulence than the one shown.
_FILTER, _GAIN = f"map+prior_std_px=1+{KALMAN}", 0.4
_STRENGTH_E = 0.8  # which the paper found best at the telescope
_TURN_S = 1.0
_IMAGES_EVERY = 10
_SETTLE_FRAMES = 20  # start of a turn, affected by the previous method
_OPEN_FRAMES = 100  # before the loop is closed, to set the guard's limit
_LEARN_FRAMES = 2000
_COMPILING_S = 600.0  # time limit of the engine, which compiles on first use, and of the learning
_PATIENCE_S = 60.0
_LOOKS_PER_FRAME = 4
_LEAST_LOOK_S = 1e-3
_TELESCOPE, _ENGINE, _PAGE, _RECORDER, _LEARNER = "telescope", "engine", "page", "recorder", "learner"
_STREHL, _COMMAND_FRAME = TRUTH.index("strehl"), TRUTH.index("command_frame")


@dataclass(frozen=True)
class LiveDemonstration:
    """A live demonstration of closed-loop operation.

    Parameters
    ----------
    folder : path
        Folder of configurations, matrices, telemetry and log files.
    photons : float
        Photo-electrons per fully illuminated sub-aperture and frame.
    rate_hz : float
        Frames per second; the turbulence moves as far per frame as at the configuration's rate.
    name : str
        Name of the engine and all streams.
    port : int
        Port of the page; 0: any free one.
    seed : int
        Seed of turbulence and noise.
    """

    folder: Path
    photons: float
    rate_hz: float
    name: str
    port: int
    seed: int

    @property
    def observed(self) -> LoopConfiguration:
        """Configuration of the simulated loop."""
        star = load_loop(_STAR).replace("camera", photons_per_subaperture=self.photons)
        return star.replace("control", gain=_GAIN).slowed_to(self.rate_hz)

    @property
    def turn_frames(self) -> int:
        """Number of frames per turn of a method."""
        return max(2 * _SETTLE_FRAMES, round(_TURN_S * self.rate_hz))

    def write_loop(self) -> Path:
        """Write the configuration of the simulated loop; return its path.

        Raises
        ------
        InputError
            When a value is out of range, or the file cannot be written.
        """
        observed, path = self.observed, self.folder / "loop.toml"
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, observed.to_text())
        return path

    def write_engine(self) -> tuple[Path, str]:
        """Write the configuration of the engine and its matrices; return the path of the former and a window.

        The interaction matrix is taken from the simulation: measuring it takes the telescope some ten
        seconds. The window, a method of `faintspot realtime run --interleave`, has its centroid gain for
        speckled spots, as a system would have measured it. Brightest pixels do better without a correction
        of their very low gain.

        Raises
        ------
        InputError
            When a file cannot be written.
        """
        observed, path = self.observed, self.folder / CONFIGURATION
        with output_errors(path):
            path.unlink(missing_ok=True)
        save(path, fixed_window(observed, centroid_gain=1.0))
        write_engine_files(observed, self.folder)
        written = Configuration(path)
        width, gain = written.settings.window_fwhm_px, written[TABLE]["centroid_gain"]
        save(path, Settings("tv", noise_std=_STRENGTH_E, flux_e=self.photons))
        model = derived(path, ".model.npz").name  # where `faintspot realtime learn` puts it
        save_control(path, gain=_GAIN, centroid_gain=1.0, model=model)
        return path, f"window+window_fwhm_px={width:g}+centroid_gain={gain:.3g}"

    def run(self, stop: threading.Event, seconds: float, say: Say) -> Shown:
        """Start all processes, compare methods for `seconds` or until `stop` is set, and end the processes.

        The loop is closed with the integrator at once. A Kalman filter is learnt from its telemetry and
        then takes turns, too.

        Parameters
        ----------
        stop : event
        seconds : float
            Time for which all methods take turns.
        say : function
            Called with one-line messages about progress and the page's address.

        Raises
        ------
        InputError
            When a value is out of range, a file cannot be written, or a process ends or does not become
            ready.
        """
        self._check_name()
        shown = Shown(self.observed.control.delay_frames)
        loop, name = self.write_loop(), ["--name", self.name]
        observed = [*name, "--seed", str(self.seed), "--wait"]
        with ChildProcesses(self.folder) as processes:

            def wait(condition: Callable[[], bool], awaited: str, timeout_s: float) -> None:
                processes.wait_until(lambda: stop.is_set() or condition(), awaited, timeout_s)

            processes.start(_PAGE, ["live", *name, "--port", str(self.port)])
            processes.start(_TELESCOPE, ["realtime", "telescope", str(loop), *observed])
            wait(lambda: len(processes.output(_PAGE)) > 0, "the page", _PATIENCE_S)
            if stop.is_set():
                return shown
            say(f"{processes.output(_PAGE)[0]}\nOpen it in a browser; Ctrl-C ends it and prints a table")
            say(f"starting telescope and engine, which compiles on first use; files: {self.folder}")
            with ControlServer(socket_path(self.name), while_starting(" in part 1 of 2")):
                engine, window = self.write_engine()
            first = ["--interleave", window, "--images-every", str(_IMAGES_EVERY)]
            processes.start(_ENGINE, ["realtime", "run", "--config", str(engine), *name, *first])
            wait(lambda: self._frames_measured() >= _OPEN_FRAMES, "slopes of the engine", _COMPILING_S)
            if stop.is_set():
                return shown
            looks_hz = _LOOKS_PER_FRAME * self.rate_hz
            with _Watcher(self.name, shown, looks_hz, processes, stop) as watcher:
                watcher.watch(_OPEN_FRAMES / self.rate_hz)
                self._asked("loop", action="close")
                say("the loop is closed with an integrator")
                self._learn(engine, window, processes, watcher, say)
                say(f"methods compared for {seconds:g} s: {', '.join(shown.methods)}")
                watcher.watch(seconds)
            telescope = request(socket_path(self.name, TELESCOPE), "status")
            shown.status = {**self._asked("status"), "telescope": telescope}
        return shown

    def _learn(
        self, engine: Path, window: str, processes: ChildProcesses, watcher: _Watcher, say: Say
    ) -> None:
        """Learn a Kalman filter from the telemetry while other methods take turns; then let it, too."""
        store = self.folder / "telemetry.zarr"
        shutil.rmtree(store, ignore_errors=True)
        say(f"a Kalman filter is learnt from {_LEARN_FRAMES} frames of the closed loop")
        told = [str(store), "--config", str(engine), "--frame-rate-hz", f"{self.rate_hz:g}"]
        recording = [str(store), "--name", self.name, "--frames", str(_LEARN_FRAMES)]
        processes.start(_RECORDER, ["realtime", "record", *recording])
        watcher.watch(_COMPILING_S, until=lambda: processes.finished(_RECORDER))
        if watcher.stopped():
            return
        self._interleave(methods := ["none", "tv", window], watcher.shown)
        processes.start(_LEARNER, ["realtime", "learn", *told], ONE_THREAD)
        try:
            watcher.watch(_COMPILING_S, until=lambda: processes.finished(_LEARNER))
            if watcher.stopped():
                return
            self._interleave([*methods, _FILTER], watcher.shown)
        except InputError as error:
            say(f"no filter takes turns: {error}")

    def _interleave(self, methods: list[str], shown: Shown) -> None:
        """Let methods take turns from now on."""
        turns = {"methods": ",".join(methods), "every": self.turn_frames}
        self._asked("interleave", timeout_s=_COMPILING_S, **turns)
        shown.begin(short_names(methods))

    def _check_name(self) -> None:
        """Refuse the name of a running engine, whose loop belongs to someone else."""
        try:
            self._asked("status")
        except InputError:
            return
        raise InputError(f"name = {self.name!r}: an engine of that name is running, expected an unused name")

    def _asked(self, command: str, **fields: Any) -> dict[str, Any]:
        return request(socket_path(self.name), command, **fields)

    def _frames_measured(self) -> int:
        """Return how many frames the engine has measured; 0 while it does not answer."""
        try:
            return int(self._asked("status")["counters"]["processed"])
        except InputError:
            return 0


@dataclass(eq=False)
class Shown:
    """Data gathered from the loop."""

    delay_frames: int
    methods: list[str] = field(default_factory=list)
    """Names of the methods that take turns."""
    first_method: int = 0
    """Number of the first of them in `rows`."""
    rows: list[tuple[float, ...]] = field(default_factory=list)
    """Rows of all frames: number, method, state of the loop, latency [us]."""
    truth: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Strehl ratio, and frame whose commands acted, by frame number; for the frames that were read."""
    status: dict[str, Any] | None = None
    """Status of the engine at the end, with that of the telescope."""

    def begin(self, methods: list[str]) -> None:
        """Let other methods take turns; the first ever follow the single method of the start."""
        self.first_method += len(self.methods) or 1
        self.methods = methods

    @property
    def table(self) -> Floats:
        """`rows` and `truth` together, (frames, 6); NaN where the truth is not known."""
        truths = [self.truth.get(int(row[0]), (np.nan, np.nan)) for row in self.rows]
        return np.hstack([np.array(self.rows).reshape(-1, 4), np.array(truths).reshape(-1, 2)])

    @property
    def open_strehl(self) -> float:
        """Mean Strehl ratio before the loop was closed; NaN if it is not known."""
        frames = self.table
        values = frames[frames[:, 2] != STATES.index(CLOSED), 4]
        return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

    @property
    def on_time(self) -> float:
        """Fraction of the closed loop's frames whose commands acted after the configured delay."""
        frames = self.table
        frames = frames[(frames[:, 2] == STATES.index(CLOSED)) & np.isfinite(frames[:, 5])]
        late = frames[:, 0] - frames[:, 5]
        return float(np.mean(late == self.delay_frames)) if len(late) else float("nan")

    def by_method(self) -> list[MethodShown]:
        """Return the result of every method in the closed loop; empty before each has had a turn.

        The first frames of each turn, still affected by the previous method, do not count towards the Strehl
        ratio.
        """
        frames = self.table
        frames = frames[(frames[:, 2] == STATES.index(CLOSED)) & (frames[:, 1] >= self.first_method)]
        method = frames[:, 1].astype(np.int64) - self.first_method
        if not self.methods or len(np.unique(method)) < len(self.methods):
            return []
        begins = np.flatnonzero(np.concatenate([[True], np.diff(method) != 0]))
        since = np.arange(len(method)) - begins[np.searchsorted(begins, np.arange(len(method)), "right") - 1]
        strehl = np.where(since < _SETTLE_FRAMES, np.nan, frames[:, 4])
        return [
            MethodShown(
                compared, int(np.sum(method == index)), *np.percentile(frames[method == index, 3], (50, 99))
            )
            for index, compared in enumerate(compared_methods(method, self.methods, strehl))
        ]


@dataclass(frozen=True)
class MethodShown:
    """Result of one method: Strehl ratio, frames, and latencies from the last row to the slopes."""

    strehl: MethodDifference
    frames: int
    p50_us: float
    p99_us: float


class _Watcher(Closing):
    """Reader of telemetry and truth as they arrive."""

    def __init__(
        self, name: str, shown: Shown, looks_hz: float, processes: ChildProcesses, stop: threading.Event
    ) -> None:
        self.shown, self._look_s = shown, max(1 / looks_hz, _LEAST_LOOK_S)
        self._processes, self._stop = processes, stop
        self._reader = TelemetryRing.attach(name)
        self._truth = Follower(f"{name}_truth")
        self._cursor = self._reader.records.written

    def stopped(self) -> bool:
        """Return whether the demonstration is to end."""
        return self._stop.is_set()

    def close(self) -> None:
        """Close stream and telemetry."""
        self._truth.close()
        self._reader.close()

    def watch(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Gather data for `seconds` or until a condition holds.

        Raises
        ------
        InputError
            When a process has ended.
        """
        end = time.monotonic() + seconds
        while not self.stopped() and not until() and time.monotonic() < end:
            self._processes.check()
            self._look()
            time.sleep(self._look_s)
        self._look()

    def _look(self) -> None:
        truth = self._truth.newest()
        if truth is not None and len(truth.values) == len(TRUTH):
            self.shown.truth[truth.number] = truth.values[_STREHL], truth.values[_COMMAND_FRAME]
        records, self._cursor, _ = self._reader.records.since(self._cursor)
        latency_us = (records["published_time_ns"] - records["last_row_time_ns"]) / 1e3
        columns = (records["frame"], records["method"], records["loop"], latency_us)
        self.shown.rows += zip(*(column.tolist() for column in columns), strict=True)
