"""A telescope, an engine that closes its loop, and its page; and what the arms in turn are worth."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.ao_loop.arms import Arm
from faintspot.ao_loop.calibration import make_pipeline
from faintspot.ao_loop.configuration import LoopConfiguration, load_loop
from faintspot.ao_loop.engine_files import write_engine_files
from faintspot.ao_loop.simulation import measure_gains
from faintspot.ao_loop.telescope_model import prepare
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors, write_atomically
from faintspot.control.configuration import CONTROLLER, save_control
from faintspot.control.learnt import INTEGRATOR, KALMAN
from faintspot.live_page.streams import NewestOfStream
from faintspot.pipeline import configuration as configuration_file
from faintspot.pipeline.settings import Settings
from faintspot.realtime.camera import StopEvent
from faintspot.realtime.child_processes import ChildProcesses
from faintspot.realtime.control import request
from faintspot.realtime.control_loop import CLOSED, STATES
from faintspot.realtime.private_socket import socket_path
from faintspot.realtime.telemetry import TelemetryReader
from faintspot.realtime.telescope import TRUTH
from faintspot.recorded.telemetry_numbers import ArmDifference, compared_arms

Floats = NDArray[np.float64]

_CONFIGURATION = "camera_3e"
# Chosen in the simulated loop, on other air than is shown.
_PRIOR_PX, _GAIN, _WINDOW_WIDTH = 1.0, 0.4, 2.8  # the last one in widths of the spots
_TURN_S = 1.0
_IMAGES_EVERY = 10
_SETTLE_FRAMES = 20  # of a turn, in which the loop forgets the arm before
_OPEN_FRAMES = 100  # before the loop is closed: the guard learns what is too much
_COMPILING_S = 600.0  # for the engine, the first time on a machine
_PATIENCE_S = 60.0
_LOOKS_PER_FRAME = 4
_LEAST_LOOK_S = 1e-3
_TELESCOPE, _ENGINE, _PAGE = "telescope", "engine", "page"
_STREHL, _COMMAND_FRAME = TRUTH.index("strehl"), TRUTH.index("command_frame")


@dataclass(frozen=True)
class LiveDemonstration:
    """What is shown.

    Parameters
    ----------
    folder : path
        For configurations, matrices and what the processes say.
    photons : float
        Photo-electrons of a fully lit sub-aperture in a frame.
    rate_hz : float
        Frames a second; the air moves as far in a frame as it does at the configuration's rate.
    name : str
        Of the engine and all streams.
    port : int
        Of the page; 0: any that is free.
    seed : int
        Of air and noise.
    """

    folder: Path
    photons: float
    rate_hz: float
    name: str
    port: int
    seed: int

    @property
    def observed(self) -> LoopConfiguration:
        """The simulated loop."""
        star = load_loop(_CONFIGURATION).replace("camera", photons_per_subaperture=self.photons)
        return star.replace("control", gain=_GAIN).slowed_to(self.rate_hz)

    @property
    def turn_frames(self) -> int:
        """Frames until it is the next arm's turn."""
        return max(2 * _SETTLE_FRAMES, round(_TURN_S * self.rate_hz))

    @cached_property
    def arms(self) -> dict[str, str]:
        """What takes turns, by its name: as `faintspot realtime interleave` understands it.

        The window is told its centroid gain on speckled spots, as a system would have measured it. "map" is
        told what the Kalman filter expects. Brightest pixels do better without their gain, which is very low.
        """
        observed = self.observed
        width = _WINDOW_WIDTH * observed.scene.seen_fwhm_px
        window = Settings("window", window_fwhm_px=width, centroid_gain=1.0, flux_e=self.photons)
        pipeline = make_pipeline(observed, prepare(observed).sensor, Arm("-", window))
        gain = float(measure_gains(observed, [pipeline], seed=self.seed)[0])
        return {
            "brightest": f"brightest+{INTEGRATOR}",
            "window": f"estimator=window+window_fwhm_px={width:.3g}+centroid_gain={gain:.3g}+{INTEGRATOR}",
            f"map+{KALMAN}": f"map+{KALMAN}",
        }

    def write_files(self) -> tuple[Path, Path]:
        """Write the loop's configuration, and all that the engine needs; return both.

        The interaction matrix is the simulation's: measuring it takes the telescope some ten seconds.

        Raises
        ------
        InputError
            For values out of range, and when a file cannot be written.
        """
        observed = self.observed
        with output_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        loop = self.folder / "loop.toml"
        write_atomically(loop, observed.to_text())
        # What is particular to one of the arms the others do not look at.
        settings = Settings("map", prior_std_px=_PRIOR_PX, flux_e=self.photons)
        engine = self.folder / "faintspot.toml"
        configuration_file.save(engine, settings)
        write_engine_files(observed, self.folder, KALMAN)
        save_control(engine, gain=_GAIN, centroid_gain=1.0, prediction=CONTROLLER)
        return loop, engine

    def run(self, stop: StopEvent, seconds: float, say: Callable[[str], None]) -> Shown:
        """Start everything, close the loop and watch it for so long, or until `stop` is set; end everything.

        Parameters
        ----------
        stop : event
        seconds : float
            With a closed loop.
        say : function
            Told in a line what happens, and where the page is.

        Raises
        ------
        InputError
            For values out of range, files that cannot be written, a process that ends by itself, and one that
            does not do what it is waited for.
        """
        self._check_name()
        say(f"a telescope is simulated, a Kalman filter learns from its loop: a minute; files: {self.folder}")
        loop, engine = self.write_files()
        shown = Shown(list(self.arms), self.observed.control.delay_frames)
        if stop.is_set():
            return shown
        with ChildProcesses(self.folder) as processes:
            name = ["--name", self.name]
            seed = ["--seed", str(self.seed)]
            turns = ["--interleave", ",".join(self.arms.values()), "--every", str(self.turn_frames)]
            images = ["--images-every", str(_IMAGES_EVERY)]
            processes.start(_TELESCOPE, ["realtime", "telescope", "run", str(loop), *name, *seed])
            processes.start(_ENGINE, ["realtime", "run", "--config", str(engine), *name, *turns, *images])
            say("telescope and engine start; the first time the engine compiles its code for a minute")

            def wait(condition: Callable[[], bool], what: str, timeout_s: float) -> None:
                processes.wait_until(lambda: stop.is_set() or condition(), what, timeout_s)

            wait(lambda: self._frames_measured() > 0, "slopes of the engine", _COMPILING_S)
            processes.start(_PAGE, ["live", *name, "--port", str(self.port)])
            wait(lambda: len(processes.said(_PAGE)) > 0, "the page", _PATIENCE_S)
            if stop.is_set():
                return shown
            processes.check()
            say(f"{processes.said(_PAGE)[0]}\nOpen it in a browser; Ctrl-C ends everything, with a table")
            begun = self._frames_measured()
            wait(lambda: self._frames_measured() >= begun + _OPEN_FRAMES, "frames", _PATIENCE_S)
            with _Watcher(self.name, shown, _LOOKS_PER_FRAME * self.rate_hz) as watcher:
                watcher.watch(processes, stop, _OPEN_FRAMES / self.rate_hz)
                self._asked("loop", action="close")
                say(f"the loop is closed; in turn for {seconds:g} s: {', '.join(self.arms)}")
                watcher.watch(processes, stop, seconds)
            shown.status = self._asked("status")
        return shown

    def _check_name(self) -> None:
        """Refuse the name of an engine that runs: its loop is somebody else's."""
        try:
            self._asked("status")
        except InputError:
            return
        raise InputError(f"name = {self.name!r}: expected one that no engine has; that one runs already")

    def _asked(self, command: str, **fields: Any) -> dict[str, Any]:
        return request(socket_path(self.name), command, **fields)

    def _frames_measured(self) -> int:
        """Return how many frames the engine has measured; 0 while it does not answer yet."""
        try:
            return int(self._asked("status")["counters"]["processed"])
        except InputError:
            return 0


@dataclass(eq=False)
class Shown:
    """What was seen of the loop."""

    arms: list[str]
    delay_frames: int
    rows: list[tuple[float, ...]] = field(default_factory=list)
    """Of every frame: its number, arm, state of the loop, latency in us."""
    truth: dict[int, tuple[float, float]] = field(default_factory=dict)
    """By frame number, where it was read: Strehl ratio, frame whose commands acted."""
    status: dict[str, Any] | None = None
    """What the engine said of itself at the end."""

    @property
    def table(self) -> Floats:
        """(frames, 6): `rows` and `truth`, NaN where that is not known."""
        known = [self.truth.get(int(row[0]), (np.nan, np.nan)) for row in self.rows]
        return np.hstack([np.array(self.rows).reshape(-1, 4), np.array(known).reshape(-1, 2)])

    @property
    def open_strehl(self) -> float:
        """Mean Strehl ratio before the loop was closed; NaN where nothing is known."""
        frames = self.table
        values = frames[frames[:, 2] != STATES.index(CLOSED), 4]
        return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

    @property
    def on_time(self) -> float:
        """Part of the closed loop's frames in which the commands acted after the delay that is set."""
        frames = self.table
        frames = frames[(frames[:, 2] == STATES.index(CLOSED)) & np.isfinite(frames[:, 5])]
        late = frames[:, 0] - frames[:, 5]
        return float(np.mean(late == self.delay_frames)) if len(late) else float("nan")

    def by_arm(self) -> list[ArmShown]:
        """Return what every arm has done in the closed loop; empty before each had a turn.

        Of each turn the first frames, in which the loop forgets the arm before, do not count for the Strehl
        ratio.
        """
        frames = self.table
        frames = frames[frames[:, 2] == STATES.index(CLOSED)]
        arm = frames[:, 1].astype(np.int64)
        if len(np.unique(arm)) < len(self.arms):
            return []
        begins = np.flatnonzero(np.concatenate([[True], np.diff(arm) != 0]))
        since = np.arange(len(arm)) - begins[np.searchsorted(begins, np.arange(len(arm)), "right") - 1]
        strehl = np.where(since < _SETTLE_FRAMES, np.nan, frames[:, 4])
        return [
            ArmShown(compared, int(np.sum(arm == place)), *np.percentile(frames[arm == place, 3], (50, 99)))
            for place, compared in enumerate(compared_arms(arm, self.arms, strehl))
        ]


@dataclass(frozen=True)
class ArmShown:
    """One arm: its Strehl ratio, frames, and latencies from the last row to the slopes."""

    strehl: ArmDifference
    frames: int
    p50_us: float
    p99_us: float


class _Watcher:
    """Reads telemetry and truth as they come."""

    def __init__(self, name: str, shown: Shown, looks_hz: float) -> None:
        self._shown, self._look_s = shown, max(1 / looks_hz, _LEAST_LOOK_S)
        self._reader = TelemetryReader.attach(name)
        self._truth = NewestOfStream(f"{name}_truth")
        self._cursor = self._reader.newest

    def __enter__(self) -> _Watcher:
        return self

    def __exit__(self, *_: object) -> None:
        self._truth.close()
        self._reader.close()

    def watch(self, processes: ChildProcesses, stop: StopEvent, seconds: float) -> None:
        """Write down what comes, for so long."""
        end = time.monotonic() + seconds
        while not stop.is_set() and time.monotonic() < end:
            processes.check()
            self._look()
            time.sleep(self._look_s)
        self._look()

    def _look(self) -> None:
        taken = self._truth.take()
        if taken is not None and len(taken[1]) == len(TRUTH):
            self._shown.truth[taken[0]] = taken[1][_STREHL], taken[1][_COMMAND_FRAME]
        records, self._cursor, _ = self._reader.records_since(self._cursor)
        latency_us = (records["published_time_ns"] - records["last_row_time_ns"]) / 1e3
        columns = (records["frame"], records["arm"], records["loop"], latency_us)
        self._shown.rows += zip(*(each.tolist() for each in columns), strict=True)
