"""Control: microseconds a frame, from slopes to commands.

Of the 4.2 m telescope, 72 slopes, every controller as it is; for more slopes the compiled Kalman filter with
its guard, as the engine and the simulation run it. Of an extremely large telescope, 9,232 slopes and 4,600
commands, the products that a Kalman filter with a constant gain consists of: whole matrices, and sparse ones
of which each slope knows its neighbours within four sub-apertures. They are filled with random numbers: what
they hold does not change the time.

Learning the Kalman filter from telemetry of the 4.2 m telescope: seconds of processor time, from nothing, and
again from the turbulence known before, which is then judged on frames not learnt from.
"""

from __future__ import annotations

import resource
import time
from functools import partial
from typing import Any

import numpy as np
from scipy import sparse

from benchmarks.measuring import Candidate, Row, Table, best, interleaved, pinned
from benchmarks.prediction import TELEMETRY_GAIN, Case
from faintspot.ao_loop import load_loop
from faintspot.ao_loop.control import slope_turbulence
from faintspot.ao_loop.telescope_model import prepare
from faintspot.control.base import Controller
from faintspot.control.commands import CommandDelayLine
from faintspot.control.compiled_kalman import CompiledKalman
from faintspot.control.guarded import Guarded
from faintspot.control.kalman import SlopePredictor
from faintspot.control.learning import KALMAN, Plant, learn
from faintspot.control.models import SlopeModel
from faintspot.control.predictive import Predictive, PseudoOpenLoop
from faintspot.control.relearning import relearn

_NOISE_PX = 0.5
_SIZES = (72, 54), (160, 97), (640, 400)
_PHOTONS, _LEARNING, _LEARNT = 20.0, (2010, 8100), 4000
"""Realisation and frames of the telemetry to learn from; frames learnt from at first."""
_LARGE, _LARGE_COMMANDS, _ACROSS, _REACH = 9232, 4600, 68, 4


def small_table() -> Table:
    """Time the controllers of the 4.2 m telescope."""
    configuration = load_loop("diffraction_limit")
    optics, control = prepare(configuration), configuration.control
    frame_s = 1 / control.frame_rate_hz
    turbulence = slope_turbulence(configuration, optics.sensor.layout.cells)
    covariances = turbulence.lagged_px2(frame_s)
    layered = SlopeModel.of_covariances(np.array([each.lagged_px2(frame_s) for each in turbulence.layers()]))
    plant = Plant(optics.interaction, optics.reconstructor, control.delay_frames, control.leak)
    slopes = np.random.default_rng(1).standard_normal(len(optics.interaction))
    errors = np.full(len(slopes), _NOISE_PX)
    model, clean = SlopeModel.of_covariances(covariances), optics.reconstructor.clean

    def line() -> CommandDelayLine:
        return CommandDelayLine(optics.mirror.commands, control.delay_frames)

    def predictive(line: CommandDelayLine, *, steady: bool) -> Controller:
        predictor = SlopePredictor(model, errors**2, steady=steady)
        return Predictive(line, plant.interaction, predictor, clean)

    def compiled(model: SlopeModel) -> Controller:
        matrix, predictor = plant.reconstructor.matrix, SlopePredictor(model, errors**2)
        return CompiledKalman(line(), plant.interaction, matrix, matrix, predictor, clean, 0.3, control.leak)

    controllers: dict[str, Controller] = {
        "integrator": plant.integrator(0.4, line()),
        "integrator, a gain for each mode": plant.integrator(
            np.full(optics.reconstructor.modes.shape[1], 0.4), line()
        ),
        "pseudo-open-loop control": PseudoOpenLoop(
            line(), plant.interaction, covariances[0], covariances[2], clean, 0.3
        ),
        "Kalman filter, gain of each frame": predictive(line(), steady=False),
        "the same with its guard": Guarded(
            line(),
            plant.interaction,
            plant.reconstructor.matrix,
            partial(predictive, steady=False),
            partial(plant.integrator, 0.3),
        ),
        "the same, compiled": compiled(model),
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
        of_mirror = interaction, interaction.T, interaction.T
        filtered = CompiledKalman(line, *of_mirror, predictor, interaction.T, 0.3, 0.01)
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
    """Time the products of a predictive filter of an extremely large telescope."""
    rng = np.random.default_rng(1)
    whole = rng.standard_normal((_LARGE, _LARGE), np.float32)
    near = sparse.kron(np.ones((2, 2)), _neighbours(), format="csr").astype(np.float32)
    commands = near[rng.integers(0, near.shape[0], _LARGE_COMMANDS)]
    vector, local = (rng.standard_normal(size).astype(np.float32) for size in (_LARGE, near.shape[1]))

    def of(matrix: Any, slopes: np.ndarray[Any, Any], times: int) -> None:
        for _ in range(times):
            matrix @ slopes

    # Correction 2, onward 2, and what the mirror added and its command 3 halves of a square matrix.
    def of_neighbours() -> None:
        of(near, local, 4)
        of(commands, local, 3)

    candidates: dict[str, Candidate] = {
        "whole matrices, float32": partial(of, whole, vector, 6),
        "neighbours within 4": of_neighbours,
    }
    with pinned():
        times = interleaved(candidates, fewest=3)
    rows = [Row(name, {"ms a frame": best(times, name) * 1e3}) for name in candidates]
    return Table("control-elt", f"Constant-gain Kalman filter, {_LARGE} slopes, one core", rows)


def _neighbours() -> Any:
    """Return a sparse matrix (n, n) with ones for neighbours of each sub-aperture in a square array."""
    band = sparse.diags([1.0] * (2 * _REACH + 1), range(-_REACH, _REACH + 1), shape=(_ACROSS, _ACROSS))
    return sparse.kron(band, band)


def learning_table() -> Table:
    """Time the learning of a Kalman filter."""
    case = Case(_PHOTONS, 0.0)
    plant, configuration = case.plant, case.configuration
    site = slope_turbulence(configuration, prepare(configuration).sensor.layout.cells)
    rate_hz = configuration.control.frame_rate_hz
    _, telemetry = case.observed(partial(plant.integrator, TELEMETRY_GAIN), *_LEARNING)
    first, rest = telemetry.part(0, _LEARNT), telemetry.part(_LEARNT, None)
    learn(KALMAN, plant, first.part(0, _LEARNT // 8), site, rate_hz)  # compile
    begun = time.process_time()
    learnt = learn(KALMAN, plant, first, site, rate_hz)
    cold = time.process_time()
    found = relearn(plant, learnt.model, rest, site, rate_hz, learnt.found)
    warm = time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rows = [
        Row("from nothing", {"s": cold - begun, "frames": float(len(first))}, "< 10 s", cold - begun < 10),
        Row("again, and judged", {"s": warm - cold, "frames": float(len(rest))}, "< 1 s", warm - cold < 1),
    ]
    notes = [
        f"{len(site.positions_m)} sub-apertures, {_PHOTONS:g} photons; {peak:.0f} MiB with the simulation"
    ]
    notes += [learnt.model.description, found.summary()]
    return Table("control-learning", "Learning the Kalman filter, processor time", rows, notes)


def run() -> list[Table]:
    """Time control."""
    return [small_table(), sizes_table(), large_table(), learning_table()]
