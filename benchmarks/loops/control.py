"""Control: microseconds a frame, from slopes to commands.

Of the 4.2 m telescope, 72 slopes, every controller as it is; for more slopes the compiled Kalman filter with
its guard, as the engine and the simulation run it. For 7 x 7 to 80 x 80 sub-apertures the integrator and the
filter for large sensors, with the bytes that a command needs and the time of reading as many. A frame of
`PredictiveControl` for 7 x 7 to 40 x 40, as a loop in Python calls it.

Learning the Kalman filter from telemetry of the 4.2 m telescope: seconds of processor time, from nothing, and
again from the turbulence known before, which is then judged on frames not learnt from.
"""

import resource
import time
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.loops.prediction import TELEMETRY_GAIN, Case
from benchmarks.measuring import Candidate, Row, Table, best, interleaved, pinned
from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.modal_model import LoopOfControl
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.predictive_control import PredictiveControl
from faintspot.loop.control.identification.recording import LoopSystem
from faintspot.loop.control.integrator import CompiledIntegrator, LoopPlant
from faintspot.loop.control.kalman.compiled import CompiledKalman, Predictive
from faintspot.loop.control.kalman.local_model import neighbours_within
from faintspot.loop.control.kalman.local_predictor import local_shapes
from faintspot.loop.control.kalman.modal_predictor import LargeGuarded
from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor
from faintspot.loop.control.reconstructor import Reconstructor
from faintspot.loop.control.relearning import relearn
from faintspot.loop.simulation import load_loop
from faintspot.loop.simulation.record import slope_turbulence
from faintspot.loop.simulation.telescope import prepare

_NOISE_PX = 0.5
_SIZES = (72, 54), (160, 97), (640, 400)
_PHOTONS, _LEARNING, _LEARNT = 20.0, (2010, 8100), 4000
"""Realisation and frames of the telemetry to learn from; frames learnt from at first."""
_GOALS_US = {7: 50, 16: 200, 40: 2000}
"""Microseconds of a frame, called from Python, for sub-apertures across the pupil."""
_MOST_SLOPES = 300  # of a filter in which each slope corrects all others
_ACROSS, _LAYERS = (7, 20, 40, 80), 3
_FEWEST_TIMES, _SECONDS = 40, 3.0


def small_table() -> Table:
    """Time the controllers of the 4.2 m telescope."""
    configuration = load_loop("diffraction_limit")
    optics, control = prepare(configuration), configuration.control
    frame_s = 1 / control.frame_rate_hz
    turbulence = slope_turbulence(configuration, optics.sensor.layout.cells)
    covariances = turbulence.lagged_px2(frame_s)
    layered = SlopeModel.of_covariances(np.array([each.lagged_px2(frame_s) for each in turbulence.layers()]))
    plant = LoopPlant(optics.interaction, optics.reconstructor, control.delay_frames, control.leak)
    slopes = np.random.default_rng(1).standard_normal(len(optics.interaction))
    errors = np.full(len(slopes), _NOISE_PX)
    model, clean = SlopeModel.of_covariances(covariances), optics.reconstructor.clean

    def line() -> CommandDelayLine:
        return CommandDelayLine(optics.mirror.commands, control.delay_frames)

    def predictive(line: CommandDelayLine, *, steady: bool) -> Controller:
        predictor = SlopePredictor(model, errors**2, steady=steady)
        return Predictive(line, plant.interaction, predictor, clean)

    def compiled(model: SlopeModel) -> Controller:
        predictor = SlopePredictor(model, errors**2)
        return CompiledKalman(line(), plant, plant.reconstructor.matrix, predictor, 0.3)

    controllers: dict[str, Controller] = {
        "integrator": plant.integrator(0.4, line()),
        "Kalman filter, gain of each frame": predictive(line(), steady=False),
        "the same with its guard, compiled": compiled(model),
        "the same, compiled, with four layers": compiled(layered),
        "Kalman filter, constant gain": predictive(line(), steady=True),
    }
    for each in controllers.values():  # compile
        each.update(slopes, errors)
        each.expected()
    with pinned():
        times = interleaved(
            {name: partial(each.update, slopes, errors) for name, each in controllers.items()}
        )
    rows = [Row(name, {"us a frame": best(times, name) * 1e6}) for name in controllers]
    return Table("control", f"Control with {len(slopes)} slopes, one core", rows)


def sizes_table() -> Table:
    """Time the compiled filter with more slopes; each goes on by itself, which does not change the time."""
    rng = np.random.default_rng(1)
    controllers: dict[str, Candidate] = {}
    bytes_read = {}
    for slopes, commands in _SIZES:
        alone = np.eye(slopes)[None]
        predictor = SlopePredictor(SlopeModel(1.5 * alone, -0.6 * alone, 0.1 * alone), np.ones(slopes))
        interaction = rng.standard_normal((slopes, commands)) / np.sqrt(slopes)
        line = CommandDelayLine(commands, 2, 1.0)
        name = f"{slopes} slopes, {commands} commands"
        filtered = CompiledKalman(line, _plant(interaction), interaction.T, predictor, 0.3)
        controllers[name] = partial(
            filtered.update, 0.1 * rng.standard_normal(slopes), rng.uniform(0.5, 1.5, slopes)
        )
        bytes_read[name] = 8 * slopes * (12 * slopes + 5 * commands)
    with pinned():
        times = interleaved(controllers)
    rows = [
        Row(name, {"us a frame": best(times, name) * 1e6, "GB/s": bytes_read[name] / best(times, name) / 1e9})
        for name in controllers
    ]
    return Table("control-sizes", "Compiled Kalman filter with its guard, one core", rows)


def large_table() -> Table:
    """Time commands of large sensors, from their slopes, against reading the bytes that they need."""
    with pinned():
        rows = [row for across in _ACROSS for row in _of_size(across)]
    notes = [
        "time from slopes to the command; what follows it until the next frame in its own column",
        "bound: the scalar product of two vectors of as many bytes together; best times",
    ]
    return Table("control-large", "Large sensors: from slopes to commands, one core", rows, notes)


def _of_size(across: int) -> list[Row]:
    """Return the rows of a sensor; matrices are random, which does not change the time."""
    rng = np.random.default_rng(1)
    cells, interaction = _random_sensor(across, rng)
    n, commands = len(cells), interaction.shape[1]
    line = CommandDelayLine(commands, 2, 1.0)
    integrator = CompiledIntegrator(line, interaction, interaction.T, 0.3, 0.01)
    rows = [_timed(f"{across} x {across}, integrator", integrator, 4 * interaction.size, 2 * n)]
    del integrator
    arrays = random_filter(cells, rng)
    line = CommandDelayLine(commands, 2, 1.0)
    same = np.zeros((commands, commands))  # the residuals compare as equal: the guard keeps the filter
    guarded = LargeGuarded(line, _plant(interaction), same, arrays, 0.3)
    return [*rows, _timed(f"{across} x {across}, prediction", guarded, 4 * interaction.size, 2 * n)]


def _plant(interaction: NDArray[np.float64]) -> LoopPlant:
    """Return a loop in which the transposed interaction matrix is the reconstructor."""
    none = np.zeros((0, 0))
    return LoopPlant(interaction, Reconstructor(interaction.T, none, none, interaction.T), 2, 0.01)


def _random_sensor(across: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sub-apertures of a round pupil, and an interaction matrix."""
    place = np.argwhere(np.ones((across, across))) - 0.5 * (across - 1)
    cells = place[np.hypot(*place.T) <= 0.5 * across]
    n, commands = len(cells), int(1.04 * len(cells))
    return cells, rng.standard_normal((2 * n, commands), np.float32).astype(np.float64) / n


def random_filter(cells: NDArray[np.float64], rng: np.random.Generator) -> dict[str, Any]:
    """Return arrays as of a filter of three layers, with weights that let its state fade."""
    near, around = neighbours_within(cells, 1.5), neighbours_within(cells, 6.0)
    shapes = {"near": near, "around": around, "share": np.full(_LAYERS, 1 / _LAYERS)}
    wanted = local_shapes(shapes, 2 * len(cells))
    filled = {
        name: 1e-2 * rng.standard_normal(wanted[name], np.float32) for name in ("weights", "corrections")
    }
    filled["corrections"] = filled["corrections"][:1]  # for one level of noise
    return {
        **shapes,
        **filled,
        "variance_px2": np.ones(2 * len(cells)),
        "predicted_px2": np.ones(2 * len(cells)),
    }


def _timed(name: str, controller: Controller, bytes_read: int, slopes: int) -> Row:
    """Return the times of a controller's updates, and of reading as many bytes, in turn."""
    first, second = np.ones((2, max(bytes_read // 8, 1)), np.float32)
    seen, errors = np.random.default_rng(2).standard_normal(slopes), np.ones(slopes)
    update = partial(controller.update, seen, errors)
    times: list[NDArray[np.float64]] = []
    begun = time.perf_counter()
    while len(times) < _FEWEST_TIMES or time.perf_counter() - begun < _SECONDS:
        marks = [time.perf_counter()]
        for each in (controller.expected, update, partial(np.dot, first, second)):
            each()
            marks.append(time.perf_counter())
        times.append(np.diff(marks))
    rest, command, reading = np.array(times[2:]).T * 1e6
    p50, p99, p99_9 = np.percentile(command, (50, 99, 99.9))
    values = {"MB": bytes_read / 1e6, "best us": command.min(), "p50": p50, "p99": p99, "p99.9": p99_9}
    bound = reading.min()
    values |= {"after it": rest.min(), "bound us": bound, "best / bound": command.min() / bound}
    return Row(name, {key: float(value) for key, value in values.items()})


def call_table() -> Table:
    """Time `PredictiveControl` as a user's loop calls it: slopes to command, then `prepare`."""
    rng, rows = np.random.default_rng(1), []
    with pinned():
        for across, goal_us in _GOALS_US.items():
            control, slopes = _control(across, rng)
            times: list[NDArray[np.float64]] = []
            begun = time.perf_counter()
            while len(times) < _FEWEST_TIMES or time.perf_counter() - begun < _SECONDS:
                marks = [time.perf_counter()]
                for step in (partial(control, slopes), control.prepare):
                    step()
                    marks.append(time.perf_counter())
                times.append(1e6 * np.diff(marks))
            command, rest = np.array(times[2:]).T
            p50, p99 = np.percentile(command, (50, 99))
            values = {"best us": command.min(), "p50": p50, "p99": p99, "after it": rest.min()}
            name = f"{across} x {across}, {len(slopes)} slopes"
            values = {key: float(value) for key, value in values.items()}
            rows.append(Row(name, values, f"p50 < {goal_us} us", bool(p50 < goal_us)))
    return Table("control-call", "A frame of `PredictiveControl`, from Python, one core", rows)


def _control(across: int, rng: np.random.Generator) -> tuple[PredictiveControl, NDArray[np.float64]]:
    """Return a controller with random matrices, and slopes that its filter goes on with."""
    cells, interaction = _random_sensor(across, rng)
    m, commands = interaction.shape
    alone = np.eye(m)[None]
    dense = {"first": 1.5 * alone, "second": -0.6 * alone, "driving_px2": 0.1 * alone}
    dense |= {"variance_px2": np.ones(m), "covariance_xy_px2": np.zeros(m // 2)}
    arrays = dense if m <= _MOST_SLOPES else random_filter(cells, rng)
    model = Kalman(arrays, 0.3, 1.0, (1.0, 2.0), np.eye(commands))
    measured = np.array([2.0, 0.1, 1.0, 0.1, 1.0, 0.1])
    numbers = measured, np.zeros((0, 6)), np.ones(commands), 0.3
    offsets: dict[str, Any] = {"reference_slopes": np.zeros(m), "flat_command": np.zeros(commands)}
    system = LoopSystem(interaction, cells, 1000.0, **offsets)
    loop = _RandomLoop(system, interaction, np.ones(m), np.ones(m), *numbers)
    return PredictiveControl(loop, model), np.asarray(0.1 * rng.standard_normal(m))


class _RandomLoop(LoopOfControl):
    """Loop with a random matrix, of which no inverse is needed."""

    def plant(self) -> LoopPlant:
        """See `LoopOfControl`."""
        none = np.zeros((self.interaction.shape[1], 0))
        reconstructor = Reconstructor(self.interaction.T, none, none, self.interaction.T)
        return LoopPlant(self.interaction, reconstructor, 2, 0.01)


def learning_table() -> Table:
    """Time the learning of a Kalman filter."""
    case = Case(_PHOTONS, 0.0)
    plant, configuration = case.plant, case.configuration
    site = slope_turbulence(configuration, prepare(configuration).sensor.layout.cells)
    rate_hz = configuration.control.frame_rate_hz
    _, telemetry = case.observed(partial(plant.integrator, TELEMETRY_GAIN), *_LEARNING)
    first, rest = telemetry.part(0, _LEARNT), telemetry.part(_LEARNT, None)
    learn_controller(plant, first.part(0, _LEARNT // 8), site, rate_hz)  # compile
    begun = time.process_time()
    learnt = learn_controller(plant, first, site, rate_hz)
    cold = time.process_time()
    found = relearn(plant, learnt, rest, site, rate_hz, learnt.identified)
    warm = time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rows = [
        Row("from nothing", {"s": cold - begun, "frames": float(len(first))}, "< 10 s", cold - begun < 10),
        Row("again, and judged", {"s": warm - cold, "frames": float(len(rest))}, "< 1 s", warm - cold < 1),
    ]
    notes = [
        f"{len(site.positions_m)} sub-apertures, {_PHOTONS:g} photons; {peak:.0f} MiB with the simulation"
    ]
    notes += [learnt.description, found.summary()]
    return Table("control-learning", "Learning the Kalman filter, processor time", rows, notes)


def run() -> list[Table]:
    """Time control."""
    return [small_table(), sizes_table(), large_table(), call_table(), learning_table()]
