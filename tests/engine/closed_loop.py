"""A simulated telescope and an engine in the process of the test, frame by frame: no clock decides what acts.

Each frame is read out while the exposure of the next one, which has begun with it, goes on; then the engine's
commands are waited for. So those computed from frame k act in frame k + 2, however busy the machine is.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyshmem
from tests.engine.bench import split
from tests.loop.simulation.loop_cases import faint
from tests.patience import wait_for

import faintspot as fs
from faintspot.base.files import Closing
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.engine.engine import Engine
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.engine.telescope import TRUTH, SimulatedTelescope
from faintspot.loop.control.base import INTEGRATOR
from faintspot.loop.control.configuration import Control, load_control
from faintspot.loop.simulation.engine_files import write_engine_files
from faintspot.slopes.pipeline import configuration as configuration_file

CONFIGURATION = faint()
BRIGHTEST = fs.Settings("brightest", keep_brightest=20)
COMMANDS, PATIENCE_S = 54, 60.0


def configured(
    folder: Path,
    settings: fs.Settings = BRIGHTEST,
    configuration: Any = CONFIGURATION,
    controller: str = INTEGRATOR,
) -> tuple[Path, Control]:
    """Write what the engine needs; return the configuration file, and its control."""
    configuration_file.save(folder / "faintspot.toml", settings)
    path = write_engine_files(configuration, folder, controller)
    control = load_control(path)
    assert control is not None
    return path, control


def make_engine(
    name: str, path: Path, control: Control | None, settings: fs.Settings | None = None, **options: Any
) -> Engine:
    described = configuration_file.Configuration(path)
    reference = None if control is None else control.reference

    def make(each: fs.Settings) -> fs.SlopePipeline:
        return fs.SlopePipeline(described.layout, each, described.calibration, reference, **described.spot)

    return Engine(
        name,
        make,
        described.settings if settings is None else settings,
        *split(options, images_every=0),
        control=control,
        **options,
    )


class RunningEngine:
    """An engine in a thread."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.telemetry = TelemetryRing.attach(engine.name)
        self._thread = threading.Thread(target=engine.run)
        self._thread.start()

    def close(self) -> None:
        self.engine.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()


class Sky(Closing):
    """The telescope, and the engines that follow it."""

    def __init__(self, name: str, configuration: Any = CONFIGURATION, **options: Any) -> None:
        self.name, self.lines = name, list[str]()
        self.telescope = SimulatedTelescope(configuration, name, say=self.lines.append, **options)
        self._truth = pyshmem.open(f"{name}_truth")
        self._pixels = pyshmem.open(f"{name}_frames")
        self.running: RunningEngine | None = None

    def start(self, engine: Engine) -> None:
        self.running = RunningEngine(engine)
        self.until(lambda: engine._waiting)

    def until(self, condition: Any) -> None:
        wait_for(condition, lambda: self.running and self.running.engine.status(), lambda: time.sleep(1e-4))

    def frame(self) -> dict[str, float]:
        """Let one more frame come, and its commands; return the truth."""
        counters = None if self.running is None else self.running.engine.counters
        before = 0 if counters is None else counters.frames_in
        self.telescope.run(1)
        if counters is not None:
            self.until(lambda: counters.frames_in > before)
        return self.truth

    @property
    def truth(self) -> dict[str, float]:
        """Of the last frame."""
        return dict(zip(TRUTH, self._truth.read().tolist(), strict=True))

    @contextmanager
    def observing(self) -> Iterator[None]:
        """Let frames come in another thread."""
        stop = threading.Event()
        runner = threading.Thread(target=self.telescope.run, args=(None, stop))
        runner.start()
        try:
            yield
        finally:
            stop.set()
            runner.join()

    @property
    def pixels(self) -> np.ndarray:
        """The last frame."""
        return np.array(self._pixels.read())

    def frames(self, count: int) -> np.ndarray:
        """Return the Strehl ratios of so many more frames."""
        return np.array([self.frame()["strehl"] for _ in range(count)])

    @property
    def records(self) -> Any:
        """All that the engine has recorded."""
        assert self.running is not None
        return self.running.telemetry.records.since(0)[0]

    @property
    def loop(self) -> ControlLoop:
        """The engine's."""
        assert self.running is not None
        assert self.running.engine.loop is not None
        return self.running.engine.loop

    def stop(self) -> None:
        if self.running is not None:
            self.running.close()
            self.running = None

    def close(self) -> None:
        self.stop()
        self._truth.close()
        self._pixels.close()
        self.telescope.close()
        (FOLDER / self.name).unlink(missing_ok=True)
        pyshmem.unlink_quiet(f"{self.name}_commands")
