"""What a study asks of images: sums over them for every candidate and k, and positions at a chosen k.

`HostTables` answers on the CPU, `faintspot.study.on_device.DeviceTables` on a GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.study.arms import Images, error_table, position_table
from faintspot.study.sweep import Cell

Floats = NDArray[np.float64]


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
    valid: NDArray[np.bool_]
    """(n, columns)."""
    sums: Floats
    """Of the errors and of their squares for every k, (2, K)."""


class Tables(Protocol):
    """Measures blocks with the arms that know nothing of the spot."""

    def sums(
        self, arm: str, candidates: Sequence[float], block: Any, *, moments: bool
    ) -> tuple[Floats, Floats | None]:
        """Return sums of (|dx| + |dy|) / 2, (candidates, K), and those of `moments_of`, if asked for."""
        ...

    def scored(self, arm: str, candidate: float, block: Any, columns: Sequence[int]) -> Scored:
        """Return positions at k = column + 1."""
        ...


class HostTables:
    """Measures blocks on the CPU.

    Parameters
    ----------
    cell : Cell
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.
    """

    def __init__(self, cell: Cell, search_range_px: float) -> None:
        self._cell, self._search_range_px = cell, search_range_px

    def sums(
        self, arm: str, candidates: Sequence[float], block: Block, *, moments: bool
    ) -> tuple[Floats, Floats | None]:
        """See `Tables`."""
        images, truth = block
        where = (self._cell, images)
        tables = (error_table(arm, c, *where, truth, self._search_range_px)[0] for c in candidates)
        sums = np.stack([table.sum(axis=0, dtype=np.float64) for table in tables])
        if not moments:
            return sums, None
        positions = (position_table(arm, c, *where, self._search_range_px)[0] for c in candidates)
        return sums, np.stack([moments_of(table, truth) for table in positions], axis=1)

    def scored(self, arm: str, candidate: float, block: Block, columns: Sequence[int]) -> Scored:
        """See `Tables`."""
        images, truth = block
        positions, valid = position_table(arm, candidate, self._cell, images, self._search_range_px)
        errors = errors_of(positions, truth[:, None])
        sums = np.stack([errors.sum(axis=0), np.square(errors).sum(axis=0)])
        return Scored(positions[:, list(columns)], valid[:, list(columns)], sums)


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
    """(|dx| + |dy|) / 2, to the precision of `faintspot.study.arms.error_table`."""
    errors: NDArray[np.float32] = np.abs(positions - truth).mean(axis=-1).astype(np.float32)
    return errors.astype(np.float64)
