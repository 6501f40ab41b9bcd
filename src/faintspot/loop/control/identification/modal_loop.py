"""Recording of a loop in the modes of its interaction matrix, their spectra and noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.reconstructor import check_controllable

Floats = NDArray[np.float64]

LEAST_MEASURED = 0.5
"""Part of a frame's slopes without which no mode of it is known; slopes that are missing count as 0."""
_SHORTEST, _LONGEST = 64, 4096  # frames of a piece
_PIECES = 6
_PLATEAU = 0.35  # cycles a frame, above which a spectrum is noise
_LEAST_NOISE = 1e-6  # of the variance of a mode


class Modes(NamedTuple):
    """Recording in modes of its interaction matrix."""

    recording: Recording
    """Of (frames, k) modes; NaN where a frame has too few slopes."""
    analysis: Floats
    """(k, m): matrix from slopes to modes, 0 for slopes never measured; its rows are orthonormal."""


def modes_of(loop: Recording) -> Modes:
    """Return a recording in as many modes as it has commands, from those that move slopes most to the least.

    Raises
    ------
    InputError
        When no frame has most slopes, or there are more commands than slopes.
    """
    measured = np.isfinite(loop.slopes)
    matrix = np.where(measured.any(axis=0)[:, None], loop.interaction_matrix, 0.0)
    check_controllable(matrix.shape[1], len(matrix))
    analysis = np.linalg.svd(matrix, full_matrices=False)[0].T
    share = measured.sum(axis=1) / max(int(measured.any(axis=0).sum()), 1)
    modes = np.where((share >= LEAST_MEASURED)[:, None], np.nan_to_num(loop.slopes) @ analysis.T, np.nan)
    if not np.isfinite(modes).any():
        raise InputError("recording: expected frames with most slopes measured, got none")
    unknown: dict[str, Any] = dict.fromkeys(("standard_errors", "covariance_xy", "prior_std", "cells"))
    return Modes(replace(loop, slopes=modes, interaction_matrix=analysis @ matrix, **unknown), analysis)


def plateau(modes: Floats) -> tuple[Floats, Floats]:
    """Return the variance of each mode's noise, from where its spectrum is flat, and frames that it is from.

    Parameters
    ----------
    modes : (frames, k) array
        Open-loop modes; NaN where not measured.
    """
    return spectra_of_modes(modes)[1], (1 - 2 * _PLATEAU) * np.isfinite(modes).sum(axis=0)


def spectra_of_modes(modes: Floats, without: slice = slice(0)) -> tuple[Floats, Floats]:
    """Return power spectra at all frequencies, (frequencies, k), and the noise of each mode.

    Some frames are left out, after which the pieces are as long as with them.
    """
    measured = np.isfinite(modes).all(axis=1)
    rows = np.arange(len(modes))
    filled = np.array([np.interp(rows, rows[measured], values[measured]) for values in modes.T]).T
    length, used = length_of_piece(len(modes)), np.delete(filled, without, axis=0)
    used -= used.mean(axis=0)
    frequency, power = welch(used, nperseg=length, detrend=False, return_onesided=False, axis=0)
    noise = np.median(power[np.abs(frequency) > _PLATEAU], axis=0)
    return power, np.maximum(noise, _LEAST_NOISE * np.var(filled, axis=0))


def length_of_piece(frames: int) -> int:
    """Return the number of frames of a piece of a spectrum."""
    power_of_two: int = 2 ** math.floor(math.log2(max(frames / _PIECES, _SHORTEST)))
    return min(power_of_two, _LONGEST, frames)
