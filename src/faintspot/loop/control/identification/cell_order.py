"""Whether cells and slopes are in the same order, from the interaction matrix.

A mirror makes smooth surfaces, so it can cancel most of the turbulence that its sensor sees. Of lenslets in
a wrong order, or of axes that are exchanged, it could cancel little more than random slopes would. Neither
noise nor the recording's length matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.slope_covariance import SlopeTurbulence

Floats = NDArray[np.float64]
Cells = NDArray[np.int64]

_FITS = 0.7
"""Least `smoothness` of a right order: of mirrors of OOPAO, HCIPy, SPECULA and soapy .92 to .98; of wrong
orders 0 to .3, of two pairs of lenslets exchanged .6 to .8. With few polynomials as modes right orders have
.86, wrong ones up to .65."""
_WRONG = 0.4  # below which nothing is learnt
_MOST_SUBAPERTURES, _FEWEST_SUBAPERTURES = 60, 9
_FEWEST_MODES = 5  # without tip and tilt: fewer need not be those with the most turbulence
_OF_NOISE = 3.0  # times the noise's, for modes of turbulence
_OF_TURBULENCE = 0.5, 0.25
"""As `_FITS` and `_WRONG`, of the modes of 500 frames of turbulence: right orders .57 to .79, shuffled ones
up to .05, with axes exchanged .09 to .4, with rows upwards .25 to .38."""
_LEAST = 1e-3  # of the largest singular value, that counts as a mode of the mirror
_OUTER_SCALE = 40.0  # sub-apertures


def modes_of_turbulence(slopes: Floats) -> Floats:
    """Return the modes (2 n, k) that stand out of the noise of open-loop slopes (frames, 2 n).

    Unknown slopes are NaN. White noise has covariances of consecutive frames of both signs.
    """
    moving = slopes - np.nanmean(np.where(np.isfinite(slopes).any(axis=0), slopes, 0.0), axis=0)
    moving = np.nan_to_num(moving)
    covariance = moving[1:].T @ moving[:-1]
    values, vectors = np.linalg.eigh(covariance + covariance.T)
    return np.asarray(vectors[:, values > _OF_NOISE * max(-values[0], 0.0)][:, -(len(values) // 4) :])


def order_remark(interaction: Floats, cells: Cells, *, of_turbulence: bool = False) -> str:
    """Return a remark of one line if some cells may not be in the order of the slopes; else nothing.

    `interaction` is that of a mirror, or of the turbulence: `modes_of_turbulence`.

    Raises
    ------
    InputError
        When they are not.
    """
    n = len(cells)
    if n < _FEWEST_SUBAPERTURES or not np.any(interaction):
        return ""
    source, fits_from, wrong_below = "the interaction matrix", _FITS, _WRONG
    if of_turbulence:
        source, (fits_from, wrong_below) = "the turbulence", _OF_TURBULENCE
    stated = smoothness(interaction, cells)
    if stated >= fits_from:
        return ""
    axes = np.roll(np.arange(2 * n), n)
    pairs = np.concatenate([np.arange(0, 2 * n, 2), np.arange(1, 2 * n, 2)])
    by_columns = cells[np.lexsort((cells[:, 0], cells[:, 1]))]
    others: dict[str, list[tuple[Floats, Cells]]] = {
        "by columns, or with y before x": [(interaction, by_columns), (interaction[axes], cells)],
        "with x and y of each sub-aperture in turn": [(interaction[pairs], cells)],
        "with y, or rows, counted upwards": [(interaction, cells * np.array([-1, 1]))],
    }
    fits = {name: max(smoothness(*order) for order in orders) for name, orders in others.items()}
    best = max(fits, key=lambda name: fits[name])
    if fits[best] >= fits_from:
        raise InputError(
            f"cells: {source} fits slopes {best} ({fits[best]:.2f} of 1, as given "
            f"{stated:.2f}); give slopes as all x, then all y, and row and column of each sub-aperture in "
            "that order"
        )
    remark = (
        f"cells: with sub-apertures in this order {source} makes no smooth wavefronts ({stated:.2f} of 1, "
        f"expected {fits_from:g}); check that row and column of each are in the order of the slopes"
    )
    if stated < wrong_below:
        raise InputError(remark)
    return remark


def smoothness(interaction: Floats, cells: Cells) -> float:
    """Return how much turbulence without tip and tilt a mirror cancels: 0 as random modes, 1 the best."""
    n = len(cells)
    if n > _MOST_SUBAPERTURES:
        middle = np.median(cells, axis=0)
        kept = np.argsort(np.square(cells - middle).sum(axis=1), kind="stable")[:_MOST_SUBAPERTURES]
        return smoothness(interaction[np.concatenate([kept, kept + n])], cells[kept])
    positions = np.asarray(cells[:, ::-1], np.float64)
    still = np.ones(1), np.zeros((1, 2))
    covariance = SlopeTurbulence(positions, 1.0, 1.0, 1.0, _OUTER_SCALE, *still).covariance_px2()
    without_tilt = np.kron(np.eye(2), np.eye(n) - 1 / n)
    covariance = without_tilt @ covariance @ without_tilt
    modes, sizes, _ = np.linalg.svd(without_tilt @ interaction, full_matrices=False)
    modes = modes[:, sizes > _LEAST * np.linalg.norm(interaction, 2)]
    if modes.shape[1] < _FEWEST_MODES:
        return 1.0
    best = np.linalg.eigvalsh(covariance)[::-1][: modes.shape[1]].sum()
    random = np.trace(covariance) * modes.shape[1] / (2 * n - 2)
    part = np.einsum("ik,ij,jk->", modes, covariance, modes, optimize=True)
    return float((part - random) / max(best - random, 1e-12 * best))
