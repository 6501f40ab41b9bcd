"""Measured properties of a controlled loop, and its model without geometry, of modes and their past."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.files import read_arrays
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.layers import Identification
from faintspot.loop.control.identification.learning import GAINS, JUDGED_PART, replayed_part
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.modal_delay import (
    law_of,
    length_of_piece,
    modes_of,
    spectra_of_modes,
)
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.open_loop import OpenLoop, of_modes, open_loop_of
from faintspot.loop.control.identification.preparation import Prepared
from faintspot.loop.control.identification.recording import LoopSystem
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.modal_predictor import (
    LAGS,
    ModalPredictor,
    modal_filter,
    prediction_errors,
)
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2
from faintspot.loop.control.reconstructor import make_reconstructor

_LEAK = 0.01

_ORDERS = (4, 8, 12, 20, 30, 50, 80, 120, 200)
_FRAMES_FOR_ORDER = 50  # frames of a recording for each coefficient
_SPECTRUM_FOR_ORDER = 5  # frames of a piece of the spectrum for each coefficient
_BLOCKS, _MOST_COMPARED = 4, 100  # of frames left out, and modes, by which orders are compared
_FEWEST_COUPLED, _MOST_SOURCES = 8, 60
"""Modes: fewer are independent; by the past of so many all are predicted."""
_UNCERTAIN = 0.1  # of the variance of residual modes: gains differ by so much between modes and with time
_RIDGES = (0.1, 0.3, 1.0, 3.0, 10.0)  # of the mean square of the past


@dataclass(frozen=True, eq=False)
class LoopOfControl:
    """Loop of a controller, with conversions from the user's unit and sign."""

    recorded: LoopSystem
    """Recorded system in the user's units and sign; its `reference_slopes` and `flat_command` are 0 here."""
    interaction: Floats
    """(2 n, commands): in slopes divided by the rms of the recording's and by their centroid gain."""
    standard_error: Floats
    """(2 n,): of such slopes; infinite where the recording has none, which are left out."""
    scale: Floats
    """(2 n,): such slopes in a unit of the user's."""
    delay: Floats
    """(6,): delay in frames, centroid gain, and that of x relative to y, each with its standard error."""
    winds: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    """(layers, 6): speed, direction and share, each with its standard error."""
    largest_command: Floats | float = math.inf
    """(commands,): stroke limit about the flat command."""
    integrator_gain: float = math.nan
    recorded_gain: float = math.nan
    """Gain of the recorded integrator on the controller's slopes, if the fallback has another one."""
    law: str = ""
    """Name of the law by which the recorded loop ran."""
    analysis: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(modes, m): matrix from such slopes to modes, of which `interaction` then has a row each; or empty."""
    recorded_interaction: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(2 n, commands): `interaction` before it was corrected, for the fallback; or empty."""

    @classmethod
    def of(
        cls,
        ready: Prepared,
        delay: LoopDelay,
        matrix: Floats,
        error: Floats | float,
        gains: Floats,
        **options: Any,
    ) -> Self:
        """Return the loop of a recording, without winds, gain and stroke limit.

        Parameters
        ----------
        ready : Prepared
        delay : LoopDelay
        matrix, error : arrays
            `interaction` and `standard_error`.
        gains : (m,) array
            Centroid gain of each slope.
        options
            Other fields.
        """
        loop = ready.recording
        recorded = replace(
            loop.system.scaled(1 / loop.unit),
            command_sign=ready.sign,
            sent_after_frames=ready.sent_after_frames,
            reference_slopes=ready.reference_slopes,
            flat_command=ready.flat_command,
        )
        errors = np.where(np.isfinite(loop.slopes).any(axis=0), error, np.inf)
        return cls(recorded, matrix, errors, 1 / (loop.unit * gains), delay.row(), **options)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the loop as arrays by their names in files, see `read`."""
        values = {f"loop_{name}": value for name, value in vars(self).items() if name != "recorded"}
        values |= {f"recorded_{name}": value for name, value in vars(self.recorded).items()}
        return {name: np.asarray(value) for name, value in values.items() if value is not None}

    @classmethod
    def read(cls, path: str | Path, contents: str) -> Self:
        """Read the loop from the file of a controller.

        Raises
        ------
        InputError
            When it cannot be read; it names the contents.
        """
        own = {f"loop_{item.name}": item.name for item in fields(cls)[1:]}
        of_system = {f"recorded_{item.name}": item.name for item in fields(LoopSystem)}
        arrays = read_arrays(path, contents, (*own, *of_system), optional=tuple(of_system)[1:])
        values = {name: array.item() if array.ndim == 0 else array for name, array in arrays.items()}
        system: dict[str, Any] = {name: values.get(stored) for stored, name in of_system.items()}
        return cls(LoopSystem(**system), **{name: values[stored] for stored, name in own.items()})

    @property
    def sign(self) -> float:
        """-1 where the user's commands are subtracted from the turbulence."""
        return self.recorded.command_sign or 1.0

    def scaled_slopes(self, slopes: Floats) -> Floats:
        """Return slopes of this loop from the user's."""
        return np.asarray((slopes - self.recorded.reference_slopes) * self.scale)

    def sent(self, command: Floats) -> Floats:
        """Return the user's command from one of this loop."""
        return np.asarray(self.sign * command + self.recorded.flat_command)

    def held(self, command: Floats) -> Floats:
        """Return the command of this loop from the user's."""
        return np.asarray(self.sign * (command - self.recorded.flat_command))

    @property
    def slopes_of_commands(self) -> Floats:
        """(m, commands): the user's matrix in such slopes."""
        scale = float(np.exp(np.log(np.abs(self.scale)).mean())) * float(self.delay[2])
        return np.asarray(scale * self.recorded.interaction_matrix)

    def plant(self) -> LoopPlant:
        """Return the loop for which controllers are made."""
        frames = max(1, round(float(self.delay[0])))
        if self.analysis.size:
            return LoopPlant(self.interaction, make_reconstructor(self.interaction), frames, _LEAK)
        reconstructor = make_reconstructor(self.interaction, measured=np.isfinite(self.standard_error))
        # The integrator is that of the recording, whatever gain of x relative to y, or mirror, was found.
        plain, gains = reconstructor, np.exp(np.log(np.abs(self.scale)).mean()) / np.abs(self.scale)
        if self.recorded_interaction.size:
            plain = make_reconstructor(self.recorded_interaction, measured=np.isfinite(self.standard_error))
        reconstructor = replace(reconstructor, matrix=plain.matrix * gains)
        return LoopPlant(self.interaction, reconstructor, frames, _LEAK)


@dataclass(frozen=True, eq=False)
class LoopInModes:
    """Loop in the modes of its interaction matrix; delay and centroid gain are known."""

    described: LoopOfControl
    seen: OpenLoop

    @classmethod
    def of(cls, ready: Prepared, delay: LoopDelay) -> Self:
        """Return the modes of a recorded loop."""
        loop = ready.recording
        gains = np.full(loop.slopes.shape[1], delay.gain)
        if loop.cells is not None:
            gains = delay.gains(len(loop.cells))
        modes = modes_of(replace(loop, slopes=loop.slopes / gains))
        in_modes, sent, run = of_modes(modes.recording)
        described = LoopOfControl.of(
            ready,
            delay,
            modes.recording.interaction_matrix,
            1.0,
            gains,
            law=law_of(delay.gain * in_modes, sent, run),
            analysis=modes.analysis,
        )
        return cls(described, open_loop_of(modes.recording, replace(delay, gain=1.0)))


Kind = Callable[[Kalman, LoopPlant, OpenLoopTelemetry, LoopInModes], Kalman]


def fit_modal_filter(
    modes: LoopInModes, telemetry: OpenLoopTelemetry | None = None, of_commands: Floats | None = None
) -> Kalman:
    """Return a filter of modes: autoregressions or, of two modes, oscillators.

    Of both, what leaves less of the last third, learnt on the rest, is learnt from all frames.

    Parameters
    ----------
    modes : LoopInModes
    telemetry : OpenLoopTelemetry, optional
        Open-loop modes of some of its frames. Default: of all.
    of_commands : (commands, commands) array, optional
        From commands to compared amplitudes, see `Kalman`. Default: to the modes that they cause.
    """
    plant = modes.described.plant()
    telemetry = modes.seen.telemetry if telemetry is None else telemetry
    if of_commands is None:
        values, vectors = np.linalg.eigh(plant.interaction.T @ plant.interaction)
        of_commands = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    phase = of_commands @ plant.reconstructor.matrix
    gain, residual = plant.best_gain(GAINS, replayed_part(telemetry, len(plant.interaction)), phase)
    model = Kalman({}, gain, 1.0, (math.inf, residual), of_commands)

    def learnt(kind: Kind, learning: OpenLoopTelemetry, scored: OpenLoopTelemetry) -> Kalman:
        return kind(model, plant, learning, modes).scored(plant, scored)

    kinds: list[Kind] = [_autoregressions]
    if len(plant.interaction) == 2:
        kinds.append(_oscillators)
    first = len(telemetry) - round(JUDGED_PART * len(telemetry))
    if len(kinds) > 1:
        parts = telemetry.part(0, first), telemetry.part(first, None)
        kinds.sort(key=lambda kind: learnt(kind, *parts).left[0])
    return learnt(kinds[0], telemetry, replayed_part(telemetry, len(plant.interaction)))


def _autoregressions(
    model: Kalman, plant: LoopPlant, telemetry: OpenLoopTelemetry, loop: LoopInModes
) -> Kalman:
    modes = np.where(telemetry.trust > 0, telemetry.open_loop_px, np.nan)
    orders = best_orders(modes, plant.delay_frames)
    text = f"{orders.min()}" if orders.min() == orders.max() else f"{orders.min()} to {orders.max()}"
    description = f"{len(orders)} mode{'s' * (len(orders) > 1)}, autoregressions of order {text}"
    power, noise = spectra_of_modes(modes)
    uncertain, is_coupled = _UNCERTAIN * loop.seen.residual.var(axis=0), len(orders) >= _FEWEST_COUPLED
    rows = LAGS[-1] + 1 if is_coupled else 0
    arrays = modal_filter(power + uncertain, noise + uncertain, orders, rows)
    if is_coupled:
        arrays["coupling"], saved = coupling(arrays, modes, plant.delay_frames)
        description += f", whose errors the past of others makes smaller by {100 * saved:.1f} %"
    return replace(model, arrays=arrays, description=description)


def _oscillators(model: Kalman, plant: LoopPlant, telemetry: OpenLoopTelemetry, loop: LoopInModes) -> Kalman:
    """Return the filter of two modes as of tip and tilt of a single sub-aperture."""
    rate_hz = loop.described.recorded.frame_rate_hz
    single = LoopSystem(None, np.zeros((1, 2)), rate_hz)
    fit = Identification(telemetry, single.site, rate_hz).layers()
    return model.best_of(plant, telemetry, [fit])


def best_orders(modes: Floats, frames: int) -> NDArray[np.int64]:
    """Return the order of each mode that predicts best in frames left out of learning, block by block.

    Parameters
    ----------
    modes : (frames, k) array
        Open-loop modes; NaN where not measured. Of many, some are compared, and the others like the nearest.
    frames : int
        For how many frames later modes are predicted.
    """
    length, numbers = length_of_piece(len(modes)), np.arange(modes.shape[1])
    compared = np.unique(np.geomspace(1, len(numbers), _MOST_COMPARED).astype(int)) - 1
    nearest = np.argmin(np.abs(numbers[:, None] - compared), axis=1)
    most = min(len(modes) // _FRAMES_FOR_ORDER, length // _SPECTRUM_FOR_ORDER)
    orders = np.array([order for order in _ORDERS if order <= most] or _ORDERS[:1])
    seen = modes[:, compared]
    left, edges = np.zeros((len(orders), len(compared))), np.linspace(0, len(modes), _BLOCKS + 1).astype(int)
    for block in map(slice, edges[:-1], edges[1:]):
        spectra = spectra_of_modes(seen, block)
        for errors, order in zip(left, orders, strict=True):
            predicted = prediction_errors(modal_filter(*spectra, order), np.nan_to_num(seen), frames)
            errors += np.square(predicted[block]).sum(axis=0)
    return np.asarray(orders[np.argmin(left, axis=0)][nearest])


def coupling(arrays: dict[str, Floats], modes: Floats, frames: int) -> tuple[Floats, float]:
    """Return how the past of the strongest modes corrects predictions, and what part of errors that saves.

    By ridge regression of the errors of predictions, the ridge chosen on frames left out, block by block.

    Parameters
    ----------
    arrays : dict
        Filter of independent modes, see `ModalPredictor`.
    modes : (frames, k) array
        Open-loop modes; NaN where not measured.
    frames : int
        For how many frames later modes are predicted.

    Returns
    -------
    (lags * sources, k) array, float
        The coupling, 0 if it saves nothing, and the part.
    """
    past, errors = _past_and_errors(arrays, modes, frames)
    blocks = np.array_split(np.arange(len(past)), _BLOCKS)
    products = [(past[block].T @ past[block], past[block].T @ errors[block]) for block in blocks]
    square, crossed = (np.sum(parts, axis=0) for parts in zip(*products, strict=True))
    ridges = np.multiply.outer(_RIDGES, np.trace(square) / len(square) * np.eye(len(square)))
    left = np.zeros(len(_RIDGES))
    for block, (own, own_crossed) in zip(blocks, products, strict=True):
        for number, ridge in enumerate(ridges):
            weights = np.linalg.solve(square - own + ridge, crossed - own_crossed)
            left[number] += float(np.square(errors[block] - past[block] @ weights).sum())
    saved = 1 - float(left.min() / np.square(errors).sum())
    if saved <= 0:
        return np.zeros_like(crossed), 0.0
    return np.linalg.solve(square + ridges[int(np.argmin(left))], crossed), saved


def _past_and_errors(arrays: dict[str, Floats], modes: Floats, frames: int) -> tuple[Floats, Floats]:
    """Return the past of the strongest modes, and by how much modes then differ from their prediction."""
    predictor, sources = ModalPredictor(arrays), min(modes.shape[1], _MOST_SOURCES)
    past, errors = np.zeros((len(modes), len(LAGS) * sources)), np.full(modes.shape, np.nan)
    measured = np.asarray(np.isfinite(modes).all(axis=1))
    for number, (row, is_measured) in enumerate(zip(np.nan_to_num(modes), measured, strict=True)):
        predictor.correct(row, np.full(len(row), 0.0 if is_measured else LARGEST_VARIANCE_PX2))
        past[number] = predictor.past(sources)
        if number + frames < len(modes):
            errors[number] = modes[number + frames] - predictor.ahead(frames)
        predictor.advance()
    used = np.flatnonzero(np.isfinite(errors).all(axis=1))[len(arrays["gains"]) :]
    return past[used], errors[used]


def share_of_modes(modes: LoopInModes, winds: Kalman, plant: LoopPlant, seen: OpenLoop) -> float:
    """Return what modes leave, in what a filter of winds leaves of the last third of its slopes.

    The modes have not learnt from these frames, other than the winds.

    Parameters
    ----------
    modes : LoopInModes
    winds : Kalman
    plant : LoopPlant
        For which the filter of winds is.
    seen : OpenLoop
        What it has learnt from.
    """
    own, telemetry = modes.described.plant(), modes.seen.telemetry
    first = len(telemetry) - round(JUDGED_PART * len(telemetry))
    learnt = fit_modal_filter(modes, telemetry.part(0, first), winds.phase_of_commands)
    left = learnt.scored(own, telemetry.part(first, None)).left[0]
    return left / winds.scored(plant, seen.telemetry.part(first, None)).left[0]
