"""Model of a loop without geometry: modes of the interaction matrix, each predicted on its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.controlled_loop import LoopInModes
from faintspot.loop.control.identification.layers import Identification
from faintspot.loop.control.identification.learning import GAINS, JUDGED_PART, replayed_part
from faintspot.loop.control.identification.modal_loop import length_of_piece, spectra_of_modes
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.open_loop import OpenLoop, site_of_loop
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.modal_predictor import modal_filter, prediction_errors

Floats = NDArray[np.float64]
Kind = Callable[[Kalman, LoopPlant, OpenLoopTelemetry, float], Kalman]

_ORDERS = (4, 8, 12, 20, 30, 50, 80, 120, 200)
_FRAMES_FOR_ORDER = 80  # frames of a recording for each coefficient
_SPECTRUM_FOR_ORDER = 5  # frames of a piece of the spectrum for each coefficient
_BLOCKS, _MOST_COMPARED = 4, 100  # of frames left out, and modes, by which orders are compared


def learn_modes(
    plant: LoopPlant, telemetry: OpenLoopTelemetry, rate_hz: float, of_commands: Floats | None = None
) -> Kalman:
    """Return a filter of independent modes: autoregressions or, of two modes, oscillators.

    Of both, what leaves less of the last third, learnt on the rest, is learnt from all frames.

    Parameters
    ----------
    plant : LoopPlant
        With the interaction matrix in modes.
    telemetry : OpenLoopTelemetry
        Open-loop modes.
    rate_hz : float
        Frames per second.
    of_commands : (commands, commands) array, optional
        From commands to compared amplitudes, see `Kalman`. Default: to the modes that they cause.
    """
    if of_commands is None:
        values, vectors = np.linalg.eigh(plant.interaction.T @ plant.interaction)
        of_commands = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    phase = of_commands @ plant.reconstructor.matrix
    gain, residual = plant.best_gain(GAINS, replayed_part(telemetry, len(plant.interaction)), phase)
    model = Kalman({}, gain, 1.0, (math.inf, residual), of_commands)

    def learnt(kind: Kind, learning: OpenLoopTelemetry, scored: OpenLoopTelemetry) -> Kalman:
        return kind(model, plant, learning, rate_hz).scored(plant, scored)

    kinds: list[Kind] = [_autoregressions]
    if len(plant.interaction) == 2:
        kinds.append(_oscillators)
    first = len(telemetry) - round(JUDGED_PART * len(telemetry))
    if len(kinds) > 1:
        parts = telemetry.part(0, first), telemetry.part(first, None)
        kinds.sort(key=lambda kind: learnt(kind, *parts).left[0])
    return learnt(kinds[0], telemetry, replayed_part(telemetry, len(plant.interaction)))


def _autoregressions(model: Kalman, plant: LoopPlant, telemetry: OpenLoopTelemetry, rate_hz: float) -> Kalman:
    modes = np.where(telemetry.trust > 0, telemetry.open_loop_px, np.nan)
    orders = best_orders(modes, plant.delay_frames)
    text = f"{orders.min()}" if orders.min() == orders.max() else f"{orders.min()} to {orders.max()}"
    description = f"{len(orders)} mode{'s' * (len(orders) > 1)}, autoregressions of order {text}"
    return replace(model, arrays=modal_filter(*spectra_of_modes(modes), orders), description=description)


def _oscillators(model: Kalman, plant: LoopPlant, telemetry: OpenLoopTelemetry, rate_hz: float) -> Kalman:
    """Return the filter of two modes as of tip and tilt of a single sub-aperture."""
    single = Recording(np.zeros((1, 2)), None, None, np.zeros((1, 2)), rate_hz)
    fit = Identification(telemetry, site_of_loop(single), rate_hz).layers()
    return model.learnt(plant, telemetry, [fit])


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
    own, telemetry, rate_hz = modes.described.plant(), modes.seen.telemetry, modes.rate_hz
    first = len(telemetry) - round(JUDGED_PART * len(telemetry))
    learnt = learn_modes(own, telemetry.part(0, first), rate_hz, winds.phase_of_commands)
    left = learnt.scored(own, telemetry.part(first, None)).left[0]
    return left / winds.scored(plant, seen.telemetry.part(first, None)).left[0]
