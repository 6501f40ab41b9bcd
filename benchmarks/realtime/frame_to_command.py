"""From the last row of a frame to its command, sensors of 7 x 7 to 80 x 80 sub-apertures of 8 x 8 pixels.

A process writes frames by rows into the pixel ring, over `READOUT` of the frame time; the engine measures a
plain centre of gravity and computes commands, with the integrator or with the filter for large sensors. The
loop is closed, but frames do not follow the commands. Matrices are random, which does not change the time.
The engine itself measures the time from the last row's arrival to the publication of the commands. Without
and with a product that is begun while rows arrive ("after the last row", "while rows arrive"): blocks of
frames in turn.

Engine and camera have real-time priority where that is permitted; else the scheduler would be measured on a
busy machine. The bound is the time of a scalar product that reads as many bytes as the product.

pyRTC's compiled functions, called one after the other with all of a frame there: centre of gravity of a whole
square of as many sub-apertures across (it measures all of them), and its leaky integrator, which reads a
matrix for the slopes and commands of the round sensor.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.loops.control import random_filter
from benchmarks.measuring import Row, Table
from benchmarks.realtime import pyrtc
from faintspot.engine.engine import Engine
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.timing import Latencies
from faintspot.engine.processes.child_processes import real_time
from faintspot.engine.settings.plan import EngineOptions
from faintspot.loop.control import integrator
from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.kalman.modal_predictor import LargeGuarded
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.control.reconstructor import Reconstructor

PIXELS, LEVEL_ADU, READOUT, COMMANDS_PER_SUBAPERTURE = 8, 100, 0.8, 1.04
INTEGRATOR, PREDICTION = "integrator", "prediction"
RATES_HZ = {
    (7, INTEGRATOR): 500,
    (20, INTEGRATOR): 300,
    (40, INTEGRATOR): 200,
    (80, INTEGRATOR): 15,
    (7, PREDICTION): 300,
    (20, PREDICTION): 200,
    (40, PREDICTION): 80,
    (80, PREDICTION): 5,
}
"""Frames/s at which one core has time for the whole of a frame's work, on a slow one."""
SECONDS, ROUNDS = float(os.environ.get("FAINTSPOT_FRAME_TO_COMMAND_S", "6")), 4
AFTER, DURING, READING = "after the last row", "while rows arrive", "reading"
_STACK, _FEWEST, _SETTLE = 4, 20, 3
_PRIORITY = 50
"""Real-time priority of engine and camera, where it is permitted."""


def layout_of(across: int) -> fs.Layout:
    """Return the sub-apertures of a round sensor."""
    return fs.Layout.grid((across, across), pixels=PIXELS, outer_radius=0.5 * across)


class RandomControl(Control):
    """Control with random matrices, which takes no time to invert them."""

    predicts: bool
    """Whether the controller is the filter for large sensors."""
    centres: NDArray[np.float64]

    @classmethod
    def of(cls, layout: fs.Layout, *, predicts: bool) -> RandomControl:
        """Return control of a mirror with about as many commands as sub-apertures."""
        n = len(layout)
        shape = 2 * n, int(COMMANDS_PER_SUBAPERTURE * n)
        interaction = np.random.default_rng(1).standard_normal(shape, np.float32).astype(np.float64) / n
        cls.predicts, cls.centres = predicts, (layout.centres - layout.centres.mean(axis=0)) / PIXELS
        options = ControlOptions(largest_residual_px=1e30, most_invalid=1.0, leak=0.1)
        return cls(interaction, None, options)

    @cached_property
    def reconstructor(self) -> Reconstructor:
        """See `Control`."""
        none = np.zeros((0, 0))
        return Reconstructor(self.interaction.T, none, none, self.interaction.T)

    def controller(self, line: CommandDelayLine) -> Controller:
        """See `Control`."""
        if not self.predicts:
            return super().controller(line)
        arrays = random_filter(self.centres, np.random.default_rng(2))
        same = np.zeros((self.commands, self.commands))  # residuals compare as equal: the filter stays
        return LargeGuarded(line, self.plant, same, arrays, 0.3)

    def rehearse(self) -> None:
        """See `Control`; these matrices need no test."""


def stack_of(layout: fs.Layout) -> NDArray[np.uint16]:
    """Simulate raw frames."""
    detector = fs.slopes.simulate.Detector(2.0, offset_adu=LEVEL_ADU, bits=16)
    raw, _ = fs.slopes.simulate.sensor_frames(
        layout,
        _STACK,
        flux_e=300.0,
        detector=detector,
        rng=np.random.default_rng(1),
    )
    return raw


def _write(name: str, across: int, rate_hz: float) -> None:
    """Write frames by rows of sub-apertures until the parent ends this process."""
    layout = layout_of(across)
    stack = stack_of(layout)
    with PixelRing.create(name, layout.frame_shape, np.uint16) as ring:
        start, number = time.monotonic() + 0.1, 0
        while True:
            begun, frame, slot = start + number / rate_hz, stack[number % _STACK], ring.begin(number)
            for block in range(1, across + 1):
                rows = slice((block - 1) * PIXELS, block * PIXELS)
                due = begun + block / across * READOUT / rate_hz
                time.sleep(max(0.0, due - time.monotonic()))
                slot[rows] = frame[rows]
                ring.rows_ready(rows.stop)
            number += 1


@contextmanager
def _camera(name: str, across: int, rate_hz: float) -> Iterator[None]:
    command = [sys.executable, "-m", "benchmarks.realtime.frame_to_command", name, str(across), str(rate_hz)]
    process = subprocess.Popen(command)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


class _Turns(Latencies):
    """Latencies of commands, while whole products and begun ones take turns."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._frames, self._count = frames, 0
        self._least = {DURING: integrator._LEAST_BYTES, AFTER: sys.maxsize}
        self.found: dict[str, list[int]] = {way: [] for way in self._least}
        self._choose(AFTER)

    def add(self, duration_ns: int) -> None:
        """Count a duration, and choose the way of the next frame."""
        if self._count % self._frames >= _SETTLE:
            self.found[self.way].append(duration_ns)
        self._count += 1
        self._choose(DURING if self._count // self._frames % 2 else AFTER)

    def end(self) -> None:
        """Choose the usual way."""
        self._choose(DURING)
        integrator._LEAST_BYTES = self._least[DURING]

    def _choose(self, way: str) -> None:
        self.way = way
        integrator._LEAST_BYTES = self._least[way]


def measured(across: int, kind: str) -> dict[str, NDArray[np.float64]]:
    """Return latencies of commands with whole products and with begun ones, and of reading as much, us."""
    layout, rate_hz = layout_of(across), RATES_HZ[across, kind]
    control = RandomControl.of(layout, predicts=kind == PREDICTION)
    first, second = np.ones((2, max(control.interaction.size // 2, 1)), np.float32)
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    calibration = fs.Calibration(dark=float(LEVEL_ADU), read_noise_e=2.0)
    engine = Engine(
        name,
        lambda each: fs.SlopePipeline(layout, each, calibration),
        fs.Settings("thresholded", threshold_e=0.0),
        EngineOptions(images_every=0),
        control=control,
    )
    assert engine.loop is not None
    frames = max(_FEWEST, round(SECONDS * rate_hz / (2 * ROUNDS))) + _SETTLE
    engine.loop.latencies = turns = _Turns(frames)
    engine.loop.close()
    with real_time(priority=_PRIORITY):
        with _camera(name, across, rate_hz):
            engine.run(2 * ROUNDS * frames)
        turns.end()
        reading = []
        for _ in range(_FEWEST):
            start = time.perf_counter_ns()
            np.dot(first, second)
            reading.append(time.perf_counter_ns() - start)
    if not engine.loop.closed:
        raise RuntimeError(f"the loop has opened: {engine.loop.opened_because}")
    return {way: np.array(each) / 1e3 for way, each in {**turns.found, READING: reading}.items()}


def pyrtc_us(across: int) -> NDArray[np.float64]:
    """Return the times of pyRTC's functions, from a frame that is there to its command, us."""
    from pyrtc import loop  # type: ignore[import-untyped, unused-ignore]

    layout = layout_of(across)
    n, commands = len(layout), int(COMMANDS_PER_SUBAPERTURE * len(layout))
    shape = across * PIXELS, across * PIXELS
    image = np.random.default_rng(1).poisson(3.0, shape).astype(np.int32)
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    with pyrtc.streams_in(name, shape):
        component = pyrtc.slopes_process(name, [], PIXELS)
        try:
            measure = pyrtc.pyrtc_kernel(component, image, PIXELS)
            matrix = np.random.default_rng(1).standard_normal((commands, 2 * n), np.float32)
            old, new = np.zeros((2, commands), np.float32)
            arguments = matrix, old, new, np.float32(0.1), commands
            loop.leaky_integrator_numba(measure().ravel()[: 2 * n], *arguments)  # compiles
            times: list[int] = []
            begun = time.perf_counter()
            with real_time(priority=_PRIORITY):
                while len(times) < _FEWEST or time.perf_counter() - begun < SECONDS / 4:
                    start = time.perf_counter_ns()
                    loop.leaky_integrator_numba(measure().ravel()[: 2 * n], *arguments)
                    times.append(time.perf_counter_ns() - start)
        finally:
            component.close()
    return np.array(times[_SETTLE:]) / 1e3


def _row(name: str, times: NDArray[np.float64], bound: float) -> Row:
    p50, p99, p99_9 = np.percentile(times, (50, 99, 99.9))
    values = {"frames": len(times), "best": times.min(), "p50": p50, "p99": p99, "p99.9": p99_9}
    values |= {"bound": bound, "best / bound": times.min() / bound, "p50 / bound": p50 / bound}
    return Row(name, {key: float(value) for key, value in values.items()})


def command_table() -> Table:
    """Measure all sizes."""
    rows, bounds = [], {}
    for across, kind in RATES_HZ:
        times = measured(across, kind)
        bounds[across] = bound = times.pop(READING).min()
        rows += [_row(f"{across} x {across}, {kind}, {way}", each, bound) for way, each in times.items()]
    notes = [f"frames/s: {', '.join(f'{rate:g}' for rate in RATES_HZ.values())}; one thread measures"]
    if all(importlib.util.find_spec(package) for package in ("pyrtc", "pyshmem")):
        rows += [
            _row(f"{across} x {across}, pyRTC's functions", pyrtc_us(across), bound)
            for across, bound in bounds.items()
        ]
    else:
        notes.append(pyrtc.MISSING)
    return Table("realtime-command", "From the last row to the command, us", rows, notes)


if __name__ == "__main__":
    _write(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
