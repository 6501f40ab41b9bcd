"""A simulated telescope, an engine that closes its loop and its page; with a comparison of methods."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.closing import Closing
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors, write_atomically
from faintspot.engine.loop.control_loop import CLOSED, STATES
from faintspot.engine.pixels.readout import StopEvent
from faintspot.engine.requests.child_processes import ChildProcesses
from faintspot.engine.requests.private_socket import socket_path
from faintspot.engine.requests.requests import request
from faintspot.engine.streams.stream import Follower
from faintspot.engine.telemetry.numbers import MethodDifference, compared_methods
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.engine.telescope.simulated_telescope import TRUTH
from faintspot.loop.control.base import INTEGRATOR, KALMAN
from faintspot.loop.control.configuration import CONTROLLER, save_control
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration, load_loop
from faintspot.loop.simulation.engine_files import fixed_window, write_engine_files
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.simulation import measure_gains
from faintspot.loop.simulation.telescope.calibration import make_pipeline
from faintspot.loop.simulation.telescope.model import prepare
from faintspot.slopes.pipeline.configuration import save
from faintspot.slopes.pipeline.settings import Settings

Floats = NDArray[np.float64]

_CONFIGURATION = "camera_3e"
# Chosen in the simulated loop with other realisations of the turbulence than the one shown.
_PRIOR_PX, _GAIN = 1.0, 0.4
_TURN_S = 1.0
_IMAGES_EVERY = 10
_SETTLE_FRAMES = 20  # start of a turn, affected by the previous method
_OPEN_FRAMES = 100  # before the loop is closed, to set the guard's limit
_COMPILING_S = 600.0  # time limit of the engine, which compiles on first use
_PATIENCE_S = 60.0
_LOOKS_PER_FRAME = 4
_LEAST_LOOK_S = 1e-3
_TELESCOPE, _ENGINE, _PAGE = "telescope", "engine", "page"
_STREHL, _COMMAND_FRAME = TRUTH.index("strehl"), TRUTH.index("command_frame")


@dataclass(frozen=True)
class LiveDemonstration:
    """A live demonstration of closed-loop operation.

    Parameters
    ----------
    folder : path
        Folder of configurations, matrices and log files.
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
        star = load_loop(_CONFIGURATION).replace("camera", photons_per_subaperture=self.photons)
        return star.replace("control", gain=_GAIN).slowed_to(self.rate_hz)

    @property
    def turn_frames(self) -> int:
        """Number of frames per turn of a method."""
        return max(2 * _SETTLE_FRAMES, round(_TURN_S * self.rate_hz))

    @cached_property
    def methods(self) -> dict[str, str]:
        """Methods that take turns, by name, in the format of `faintspot realtime run --interleave`.

        The window uses its centroid gain for speckled spots, as a system would have measured it. "map" uses
        the Kalman filter's prediction. Brightest pixels do better without a correction of their very low
        gain.
        """
        observed = self.observed
        window = fixed_window(observed, centroid_gain=1.0)
        pipeline = make_pipeline(observed, prepare(observed).sensor, Method("-", window))
        gain = float(measure_gains(observed, [pipeline], seed=self.seed)[0])
        options = f"window_fwhm_px={window.window_fwhm_px:g}+centroid_gain={gain:.3g}"
        return {
            "brightest": f"brightest+{INTEGRATOR}",
            "window": f"estimator=window+{options}+{INTEGRATOR}",
            f"map+{KALMAN}": f"map+{KALMAN}",
        }

    def write_files(self) -> tuple[Path, Path]:
        """Write the configurations of the loop and of the engine; return both paths.

        The interaction matrix is taken from the simulation: measuring it takes the telescope some ten
        seconds.

        Raises
        ------
        InputError
            When a value is out of range, or a file cannot be written.
        """
        observed = self.observed
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        loop = self.folder / "loop.toml"
        write_atomically(loop, observed.to_text())
        # Settings of one method, which the other methods ignore.
        settings = Settings("map", prior_std_px=_PRIOR_PX, flux_e=self.photons)
        engine = self.folder / "faintspot.toml"
        save(engine, settings)
        write_engine_files(observed, self.folder, KALMAN)
        save_control(engine, gain=_GAIN, centroid_gain=1.0, prediction=CONTROLLER)
        return loop, engine

    def run(self, stop: StopEvent, seconds: float, say: Callable[[str], None]) -> Shown:
        """Start all processes, watch the closed loop for `seconds` or until `stop` is set, and end them.

        Parameters
        ----------
        stop : event
        seconds : float
            Time with a closed loop.
        say : function
            Called with one-line messages about progress and the page's address.

        Raises
        ------
        InputError
            When a value is out of range, a file cannot be written, or a process ends or does not become
            ready.
        """
        self._check_name()
        say(f"simulating a telescope and training a Kalman filter (one minute); files: {self.folder}")
        loop, engine = self.write_files()
        shown = Shown(list(self.methods), self.observed.control.delay_frames)
        if stop.is_set():
            return shown
        with ChildProcesses(self.folder) as processes:
            name = ["--name", self.name]
            seed = ["--seed", str(self.seed)]
            turns = ["--interleave", ",".join(self.methods.values()), "--every", str(self.turn_frames)]
            images = ["--images-every", str(_IMAGES_EVERY)]
            processes.start(_TELESCOPE, ["realtime", "telescope", str(loop), *name, *seed])
            processes.start(_ENGINE, ["realtime", "run", "--config", str(engine), *name, *turns, *images])
            say("starting telescope and engine; on first use the engine compiles for about a minute")

            def wait(condition: Callable[[], bool], awaited: str, timeout_s: float) -> None:
                processes.wait_until(lambda: stop.is_set() or condition(), awaited, timeout_s)

            wait(lambda: self._frames_measured() > 0, "slopes of the engine", _COMPILING_S)
            processes.start(_PAGE, ["live", *name, "--port", str(self.port)])
            wait(lambda: len(processes.output(_PAGE)) > 0, "the page", _PATIENCE_S)
            if stop.is_set():
                return shown
            processes.check()
            say(f"{processes.output(_PAGE)[0]}\nOpen it in a browser; Ctrl-C ends it and prints a table")
            begun = self._frames_measured()
            wait(lambda: self._frames_measured() >= begun + _OPEN_FRAMES, "frames", _PATIENCE_S)
            with _Watcher(self.name, shown, _LOOKS_PER_FRAME * self.rate_hz) as watcher:
                watcher.watch(processes, stop, _OPEN_FRAMES / self.rate_hz)
                self._asked("loop", action="close")
                say(f"the loop is closed; methods compared for {seconds:g} s: {', '.join(self.methods)}")
                watcher.watch(processes, stop, seconds)
            shown.status = self._asked("status")
        return shown

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

    methods: list[str]
    delay_frames: int
    rows: list[tuple[float, ...]] = field(default_factory=list)
    """Rows of all frames: number, method, state of the loop, latency [us]."""
    truth: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Strehl ratio, and frame whose commands acted, by frame number; for the frames that were read."""
    status: dict[str, Any] | None = None
    """Status of the engine at the end."""

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
        frames = frames[frames[:, 2] == STATES.index(CLOSED)]
        method = frames[:, 1].astype(np.int64)
        if len(np.unique(method)) < len(self.methods):
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

    def __init__(self, name: str, shown: Shown, looks_hz: float) -> None:
        self._shown, self._look_s = shown, max(1 / looks_hz, _LEAST_LOOK_S)
        self._reader = TelemetryRing.attach(name)
        self._truth = Follower(f"{name}_truth")
        self._cursor = self._reader.records.written

    def close(self) -> None:
        """Close stream and telemetry."""
        self._truth.close()
        self._reader.close()

    def watch(self, processes: ChildProcesses, stop: StopEvent, seconds: float) -> None:
        """Gather data for `seconds`."""
        end = time.monotonic() + seconds
        while not stop.is_set() and time.monotonic() < end:
            processes.check()
            self._look()
            time.sleep(self._look_s)
        self._look()

    def _look(self) -> None:
        truth = self._truth.newest()
        if truth is not None and len(truth.values) == len(TRUTH):
            self._shown.truth[truth.number] = truth.values[_STREHL], truth.values[_COMMAND_FRAME]
        records, self._cursor, _ = self._reader.records.since(self._cursor)
        latency_us = (records["published_time_ns"] - records["last_row_time_ns"]) / 1e3
        columns = (records["frame"], records["method"], records["loop"], latency_us)
        self._shown.rows += zip(*(column.tolist() for column in columns), strict=True)
