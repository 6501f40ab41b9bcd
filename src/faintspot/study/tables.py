"""Errors and positions of images for every number of kept pixels at once, for arms that keep the brightest.

Images are denoised once, each is sorted once, and all numbers of kept pixels are measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintspot.estimators.gravity import KeepingBrightest
from faintspot.kernels import scoring
from faintspot.study.arms import Images

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

RULES = {"subtract_next": scoring.SUBTRACT_NEXT, "threshold": scoring.THRESHOLD}


def error_sums(
    estimators: Sequence[KeepingBrightest], images: Images, truth: Floats, search_range_px: float = math.inf
) -> Floats:
    """Return sums of (|dx| + |dy|) / 2 over images for every estimator and k, (estimators, K)."""
    tables = (error_table(each, images, truth, search_range_px)[0] for each in estimators)
    return np.stack([table.sum(axis=0, dtype=np.float64) for table in tables])


def error_table(
    estimator: KeepingBrightest, images: Images, truth: Floats, search_range_px: float = math.inf
) -> tuple[NDArray[np.float32], Bools]:
    """Return (|dx| + |dy|) / 2 of every image for every number k of kept pixels.

    Parameters
    ----------
    estimator : KeepingBrightest
        What it says of the number of pixels does not count.
    images : (n, side, side) array, float32
    truth : (n, 2) array, px
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.

    Returns
    -------
    errors : (n, K) array, float32
        For k = 1 to K = side^2 - 1, px.
    valid : (n, K) array, bool
        Whether there was light. Where not, the position counts as (0, 0).
    """
    prepared = _prepared(estimator, images)
    errors = np.empty((len(images), prepared.shape[1] - 1), np.float32)
    valid = np.empty(errors.shape, np.bool_)
    how = images.shape[-1], RULES[estimator.rule], estimator.flux_floor, search_range_px
    scoring.errors_of_every_k(prepared, *how, truth, 0, len(images), errors, valid)
    return errors, valid


def position_table(
    estimator: KeepingBrightest, images: Images, search_range_px: float = math.inf
) -> tuple[Floats, Bools]:
    """Return the positions (n, K, 2), px, whose errors `error_table` returns, and their validity (n, K)."""
    prepared = _prepared(estimator, images)
    positions = np.empty((len(images), prepared.shape[1] - 1, 2))
    valid = np.empty(positions.shape[:2], np.bool_)
    how = images.shape[-1], RULES[estimator.rule], estimator.flux_floor, search_range_px
    scoring.positions_of_every_k(prepared, *how, 0, len(images), positions, valid)
    return positions, valid


def _prepared(estimator: KeepingBrightest, images: Images) -> Images:
    """Return the images (n, pixels) as the brightest pixels are sought in them."""
    denoised = estimator.denoised(images)
    assert denoised is not None
    return np.ascontiguousarray(denoised).reshape(len(images), -1)


def moments_of(positions: Floats, truth: Floats) -> Floats:
    """Sums that a regression of (n, K, 2) positions on the truth needs, (8, K)."""
    x, y = positions[..., 0], positions[..., 1]
    whole = [len(truth), *truth.sum(axis=0), np.square(truth).sum()]
    own = [x.sum(axis=0), y.sum(axis=0), np.square(positions).sum(axis=(0, 2))]
    across = (x * truth[:, :1]).sum(axis=0) + (y * truth[:, 1:]).sum(axis=0)
    same = np.repeat(np.array(whole)[:, None], positions.shape[1], axis=1)
    return np.concatenate([same, np.stack([*own, across])])


def errors_of(positions: Floats, truth: Floats) -> Floats:
    """(|dx| + |dy|) / 2, to the precision of `error_table`."""
    errors: NDArray[np.float32] = np.abs(positions - truth).mean(axis=-1).astype(np.float32)
    return errors.astype(np.float64)
