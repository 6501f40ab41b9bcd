"""What a study asks of images: sums over them for every candidate and k, and positions at a chosen k.

`HostTables` answers on the CPU, `faintspot.study.on_device.DeviceTables` on a GPU, for arms that keep the
brightest pixels: images are denoised once, each is sorted once, and all numbers of kept pixels are measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.estimators.base import Estimator
from faintspot.estimators.gravity import KeepingBrightest
from faintspot.kernels import scoring
from faintspot.study.arm_names import keeps_every_k
from faintspot.study.arms import Images

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

RULES = {"subtract_next": scoring.SUBTRACT_NEXT, "threshold": scoring.THRESHOLD}


class Block(NamedTuple):
    """Images in the host's memory."""

    images: Images
    """(n, side, side)."""
    truth: Floats
    """True positions of their spots, (n, 2), px."""


class Scored(NamedTuple):
    """Positions of a candidate."""

    positions: Floats
    """(n, columns, 2), px."""
    valid: Bools
    """(n, columns)."""
    sums: Floats
    """Of the errors and of their squares for every k, (2, K)."""


class Tables(Protocol):
    """Measures blocks with the arms that it has tables for."""

    def takes(self, kind: type[Estimator]) -> bool:
        """Whether there are tables for an estimator."""
        ...

    def sums(self, estimators: Sequence[Any], block: Any, *, moments: bool) -> tuple[Floats, Floats | None]:
        """Return sums of (|dx| + |dy|) / 2, (estimators, K), and those of `moments_of`, if asked for."""
        ...

    def scored(self, estimator: Any, block: Any, columns: Sequence[int]) -> Scored:
        """Return positions at k = column + 1."""
        ...


class HostTables:
    """Measures blocks on the CPU.

    Parameters
    ----------
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.
    """

    def __init__(self, search_range_px: float = math.inf) -> None:
        self._search_range_px = search_range_px

    def takes(self, kind: type[Estimator]) -> bool:
        """See `Tables`."""
        return keeps_every_k(kind)

    def sums(
        self, estimators: Sequence[KeepingBrightest], block: Block, *, moments: bool
    ) -> tuple[Floats, Floats | None]:
        """See `Tables`."""
        images, truth = block
        tables = (error_table(each, images, truth, self._search_range_px)[0] for each in estimators)
        sums = np.stack([table.sum(axis=0, dtype=np.float64) for table in tables])
        if not moments:
            return sums, None
        positions = (position_table(each, images, self._search_range_px)[0] for each in estimators)
        return sums, np.stack([moments_of(table, truth) for table in positions], axis=1)

    def scored(self, estimator: KeepingBrightest, block: Block, columns: Sequence[int]) -> Scored:
        """See `Tables`."""
        images, truth = block
        positions, valid = position_table(estimator, images, self._search_range_px)
        errors = errors_of(positions, truth[:, None])
        sums = np.stack([errors.sum(axis=0), np.square(errors).sum(axis=0)])
        return Scored(positions[:, list(columns)], valid[:, list(columns)], sums)


def mean_errors(
    estimators: Mapping[str, Sequence[KeepingBrightest]],
    blocks: Iterable[tuple[Images, Floats]],
    search_range_px: float = math.inf,
) -> dict[str, Floats]:
    """Return R of lists of estimators for every k, (estimators, K) px each, over images with their truth."""
    tables = HostTables(search_range_px)
    sums: dict[str, Any] = dict.fromkeys(estimators, 0.0)
    count = 0
    for images, truth in blocks:
        count += len(images)
        for name, each in estimators.items():
            sums[name] = sums[name] + tables.sums(each, Block(images, truth), moments=False)[0]
    return {name: total / count for name, total in sums.items()}


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
    own = [x.sum(axis=0), y.sum(axis=0), np.square(positions).sum(axis=(0, 2))]
    across = (x * truth[:, :1]).sum(axis=0) + (y * truth[:, 1:]).sum(axis=0)
    return with_truth(np.stack([*own, across]), truth)


def with_truth(own: Floats, truth: Floats) -> Floats:
    """Put what the truth alone decides before the sums (4, K) of x, y, their squares and their product."""
    whole = [len(truth), *truth.sum(axis=0), np.square(truth).sum()]
    return np.concatenate([np.repeat(np.array(whole)[:, None], own.shape[1], axis=1), own])


def errors_of(positions: Floats, truth: Floats) -> Floats:
    """(|dx| + |dy|) / 2, to the precision of `error_table`."""
    errors: NDArray[np.float32] = np.abs(positions - truth).mean(axis=-1).astype(np.float32)
    return errors.astype(np.float64)
