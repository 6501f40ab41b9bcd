"""Model of a loop without geometry: modes of the interaction matrix, each predicted on its own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.controlled_loop import LoopInModes
from faintspot.loop.control.identification.learning import GAINS, JUDGED_PART, replayed_part
from faintspot.loop.control.identification.modal_loop import length_of_piece, spectra_of_modes
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.open_loop import OpenLoop
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.modal_predictor import modal_filter, prediction_errors

Floats = NDArray[np.float64]

_ORDERS = (4, 8, 12, 20, 30, 50, 80, 120, 200)
_FRAMES_FOR_ORDER = 80  # frames of a recording for each coefficient
_SPECTRUM_FOR_ORDER = 5  # frames of a piece of the spectrum for each coefficient
_BLOCKS, _MOST_COMPARED = 4, 100  # of frames left out, and modes, by which orders are compared


def learn_modes(
    plant: LoopPlant, telemetry: OpenLoopTelemetry, of_commands: ArrayLike | None = None
) -> Kalman:
    """Return a filter of independent modes, the order of whose autoregression is chosen on held-out frames.

    Parameters
    ----------
    plant : LoopPlant
        With the interaction matrix in modes.
    telemetry : OpenLoopTelemetry
        Open-loop modes.
    of_commands : (commands, commands) array, optional
        From commands to compared amplitudes, see `Kalman`. Default: to the modes that they cause.
    """
    if of_commands is None:
        values, vectors = np.linalg.eigh(plant.interaction.T @ plant.interaction)
        of_commands = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    of_commands = np.asarray(of_commands, np.float64)
    part = replayed_part(telemetry, len(plant.interaction))
    gain, plain_residual = plant.best_gain(GAINS, part, of_commands @ plant.reconstructor.matrix)
    modes = np.where(telemetry.trust > 0, telemetry.open_loop_px, np.nan)
    orders = best_orders(modes, plant.delay_frames)
    text = f"{orders.min()}" if orders.min() == orders.max() else f"{orders.min()} to {orders.max()}"
    model = replace(
        Kalman(
            modal_filter(*spectra_of_modes(modes), orders), gain, 1.0, (math.inf, plain_residual), of_commands
        ),
        description=f"{len(plant.interaction)} modes, each an autoregression of order {text}",
    )
    return model.scored(plant, part)


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
    own, telemetry = modes.described.plant(), modes.seen.telemetry
    first = len(telemetry) - round(JUDGED_PART * len(telemetry))
    learnt = learn_modes(own, telemetry.part(0, first), winds.phase_of_commands)
    left = learnt.scored(own, telemetry.part(first, None)).left[0]
    return left / winds.scored(plant, seen.telemetry.part(first, None)).left[0]
