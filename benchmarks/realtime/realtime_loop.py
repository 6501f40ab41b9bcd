"""Frame to command: what do commands add to slopes, and is the loop in real time the simulated one?

Latency: 36 sub-apertures, 66 commands, frames that are there; what the engine's thread needs from the slopes'
publication to that of the commands. Larger sensors: `control`.

Loop: a simulated telescope and an engine as processes of their own, an integrator on brightest pixels,
compared with `simulate_loop` on the same air, frame by frame. The frame rate is low and the read-out short,
so that a busy machine holds it and commands act after the delay that is set (how often is said); the winds
are as much slower, so that the loop is as late as at 250 frames/s. Two processors at least should be free.
"""

import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from benchmarks.measuring import Row, Table
from benchmarks.realtime.realtime_processes import engine_and_telescope
from faintspot import Calibration, Layout, Settings, SlopePipeline
from faintspot.engine.engine import Engine
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.settings.plan import EngineOptions
from faintspot.loop.control.base import CONTROLS
from faintspot.loop.control.configuration import Control, load_control
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.kalman.predictor import SlopeModel
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop, simulate_loop
from faintspot.loop.simulation.engine_files import write_engine_files
from faintspot.loop.simulation.record import slope_turbulence
from faintspot.loop.simulation.telescope import prepare
from faintspot.slopes.pipeline import configuration as configuration_file

FRAMES, COMMANDS = 2000, 66
LOOP_FRAMES, SETTLED, REALISATIONS, RATE_HZ = 500, 150, 3, 20.0
_TRUTH_FRAME, _TRUTH_STREHL, _TRUTH_COMMANDS = 0, 1, 6
TARGETS_US = 5.0, 20.0


def _latency() -> Table:
    """Return what commands add to slopes, us."""
    rng = np.random.default_rng(1)
    layout = Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    integrator = Control(rng.standard_normal((2 * len(layout), COMMANDS)))
    rows = [_row("integrator", layout, integrator, TARGETS_US[0])]
    configuration = load_loop("diffraction_limit")
    interaction = prepare(configuration).interaction
    covariances = slope_turbulence(configuration, layout.cells).lagged_px2(
        1 / configuration.control.frame_rate_hz
    )
    model, noise = SlopeModel.of_covariances(covariances), np.full(len(interaction), 0.25)
    learnt: dict[str, dict[str, Any]] = {
        "kalman": {
            "first": model.first,
            "second": model.second,
            "driving_px2": model.driving,
            "variance_px2": noise,
        },
    }
    for kind, arrays in learnt.items():
        known = Kalman(arrays, 0.3, 1.0, (1.0, 2.0), np.zeros_like(interaction.T))
        control = Control(interaction, None, ControlOptions(controller=kind), known)
        rows.append(_row(CONTROLS[kind], layout, control, TARGETS_US[1]))
    return Table("realtime-commands", "From slopes to commands, us", rows)


def _row(label: str, layout: Layout, control: Control, target_us: float) -> Row:
    """Time the engine's thread from the slopes' publication to that of the commands."""
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    frame = np.random.default_rng(1).poisson(1.0, layout.frame_shape).astype(np.float32)
    times = np.zeros((2, FRAMES))
    with PixelRing.create(name, layout.frame_shape, np.float32) as ring:
        engine = Engine(
            name,
            lambda each: SlopePipeline(layout, each, Calibration(dark=0.0, read_noise_e=1.0)),
            Settings("brightest", keep_brightest=12),
            EngineOptions(images_every=0),
            control=control,
        )
        loop, streams = engine.loop, engine._streams
        assert loop is not None
        loop.close()
        path = engine.live.running.paths(ring)[0]
        with streams.held():
            for index in range(FRAMES):
                ring.publish(frame)
                path.measure(index + 1, index % ring.slots)
                streams.publish_slopes(path.slopes, index)
                start = time.perf_counter_ns()
                commands = loop.follow(path.slopes, index)
                middle = time.perf_counter_ns()
                streams.publish_commands(commands, index)
                times[:, index] = middle - start, time.perf_counter_ns() - middle
                if index % 40 == 0:
                    loop.controller.begin()  # so that the guard has not seen enough to take the integrator
                loop.look_after(path.slopes.flux)
        streams.close()
        engine._telemetry.close()
    work, publishing = times / 1e3
    both = work + publishing
    columns = {
        "computing, p50": float(np.median(work)),
        "publishing, p50": float(np.median(publishing)),
        "both, p50": float(np.median(both)),
        "p99": float(np.percentile(both, 99)),
    }
    title = f"{label}, {2 * len(layout)} slopes, {control.commands} commands"
    return Row(title, columns, f"<= {target_us:g} us", columns["both, p50"] <= target_us)


def _observed(name: str, telescope: subprocess.Popen[bytes]) -> np.ndarray[Any, Any]:
    """Return the truth of every frame that could be read, (frames, values), until the telescope ends."""
    import pyshmem

    stream: Any = None
    rows: dict[int, Any] = {}
    while telescope.poll() is None:
        time.sleep(0.2 / RATE_HZ)
        with suppress(FileNotFoundError, ValueError, RuntimeError, TimeoutError):
            stream = stream or pyshmem.open(f"{name}_truth")
            publication = stream.read_publication(timeout=0.01)
            if publication.count:
                rows[publication.frame_id] = np.array(publication.payload)
    return np.array([rows[number] for number in sorted(rows)])


def compared(
    configuration: LoopConfiguration, method: Method, realisations: int = REALISATIONS
) -> dict[str, float]:
    """Return mean Strehl ratios of the engine's loop and of the simulated one, and their difference."""
    strehl = np.zeros((2, realisations))
    on_time, frames = 0.0, 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "loop.toml").write_text(configuration.to_text(), encoding="utf-8")
        configuration_file.save(folder / "faintspot.toml", method.settings)
        path = write_engine_files(configuration.replace("control", gain=method.gain), folder, method.control)
        known = load_control(path)
        assert known is not None
        run = configuration.replace("run", frames=LOOP_FRAMES, settle_frames=SETTLED)
        for number in range(realisations):
            name = f"faintspot_benchmark_{uuid4().hex[:8]}"
            options = [f"--frames={LOOP_FRAMES}", "--readout-fraction=0.3", f"--realisation={number}"]
            with engine_and_telescope(name, path, folder / "loop.toml", options) as (_, telescope):
                truth = _observed(name, telescope)
            settled = truth[truth[:, _TRUTH_FRAME] >= SETTLED]
            late = settled[:, _TRUTH_FRAME] - settled[:, _TRUTH_COMMANDS]
            on_time += np.count_nonzero(late == configuration.control.delay_frames)
            frames += len(settled)
            record = simulate_loop(run, [method], realisation=number)
            places = settled[:, _TRUTH_FRAME].astype(int)
            strehl[:, number] = settled[:, _TRUTH_STREHL].mean(), record.strehl[places].mean()
    difference = strehl[0] - strehl[1]
    return {
        "in real time": float(strehl[0].mean()),
        "simulated": float(strehl[1].mean()),
        "difference": float(difference.mean()),
        "its error": float(difference.std(ddof=1) / np.sqrt(realisations)),
        "frames": frames,
        "acted after the delay that is set": float(on_time / frames),
    }


def _loop() -> Table:
    configuration = load_loop("camera_3e").replace("camera", photons_per_subaperture=300.0).slowed_to(RATE_HZ)
    flux_e = configuration.photons
    predicting = Settings("map", flux_e=flux_e, prior_std_px=1.0)  # the filter says how wide
    methods = [
        Method("30 brightest pixels, integrator", Settings("brightest", keep_brightest=30), 0.4),
        Method("fixed window, integrator", Settings("window", flux_e=flux_e), 0.4),
        Method(
            "maximum a posteriori, Kalman filter",
            predicting,
            0.3,
            variants=("predicted",),
            control="kalman",
        ),
    ]
    rows = []
    for method in methods:
        columns = compared(configuration, method)
        within = abs(columns["difference"]) <= max(3 * columns["its error"], 0.01)
        rows.append(Row(method.label, columns, "3 errors, or 0.01", within))
    note = (
        f"{REALISATIONS} realisations, frames {SETTLED} to {LOOP_FRAMES}, {RATE_HZ:g} frames/s, 300 photons"
    )
    return Table("realtime-loop", "Strehl ratio of the loop in real time and simulated", rows, [note])


def run() -> list[Table]:
    """Measure latency and the loop."""
    return [_latency(), _loop()]
