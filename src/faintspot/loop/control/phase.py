"""Residual phase from slopes, the measure that compares controllers.

Commands are no such measure: a unit of one combination of actuators moves the phase far more than that of
another, and the combinations that move it least are the noisiest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_CORNERS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
_UNSEEN = 0.05  # of the largest singular value: piston and waffle, which slopes do not show
_MASS = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6  # products of linear elements, integrated over a side


def residual_phase(matrix: Floats, interaction: Floats, cells: ArrayLike) -> Floats:
    """Return the matrix (commands, 2 n) from slopes to amplitudes whose sum of squares is the phase variance.

    Parameters
    ----------
    matrix : (commands, 2 n) array
        From slopes to commands, as of a `Reconstructor`.
    interaction, cells
        As for `phase_of_commands`.
    """
    return np.asarray(phase_of_commands(interaction, cells) @ matrix)


def phase_of_commands(interaction: Floats, cells: ArrayLike) -> Floats:
    """Return the matrix (commands, commands) to amplitudes whose sum of squares is the phase variance.

    Commands cause a wavefront that is bilinear between the corners of the sub-apertures (Fried 1977,
    JOSA 67, 370); its variance over all sub-apertures is in (px x side of a sub-aperture)^2.

    Parameters
    ----------
    interaction : (2 n, commands) array
        Slopes for a unit of each command.
    cells : (n, 2) array of int
        Row and column of each sub-aperture in the lenslet array.
    """
    slopes, mass, mean = _corner_geometry(np.asarray(cells))
    corners = np.linalg.pinv(slopes, rcond=_UNSEEN) @ interaction
    corners -= mean @ corners
    values, vectors = np.linalg.eigh(corners.T @ mass @ corners)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _corner_geometry(cells: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
    """Return slopes (2 n, corners) of the phase at corners, and matrix and weights of its square and mean."""
    n = len(cells)
    cell_corners = cells[:, None] + _CORNERS
    corners, of_cell = np.unique(cell_corners.reshape(-1, 2), axis=0, return_inverse=True)
    of_cell = of_cell.reshape(n, len(_CORNERS))
    slopes, mass = np.zeros((2 * n, len(corners))), np.zeros((len(corners),) * 2)
    for number, corner in enumerate(of_cell):
        slopes[number, corner] = _CORNERS[:, 1] - 0.5
        slopes[n + number, corner] = _CORNERS[:, 0] - 0.5
        mass[np.ix_(corner, corner)] += np.kron(_MASS, _MASS) / n
    return slopes, mass, mass.sum(axis=0)
