"""Methods that alternated, compared turn by turn in numbers for each frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import UNKNOWN, Estimate, mean_by_blocks

_TURNS_TOGETHER = 10  # neighbouring turns of the bootstrap's blocks: the turbulence changes slowly


@dataclass(frozen=True)
class MethodDifference:
    """A quantity in one method, and by how much it differs from the first method, turn by turn."""

    method: str
    mean: Estimate
    difference: Estimate | None
    """None of the first method."""


def compared_methods(
    methods: NDArray[np.int64], names: Sequence[str], values: Floats
) -> list[MethodDifference]:
    """Compare alternating methods in a number for each frame; each turn with the first method's same turn.

    Intervals come from a bootstrap of blocks of ten neighbouring turns.

    Parameters
    ----------
    methods : (n,) array
        Of each frame.
    names : sequence of str
        Of the methods that have frames, by number.
    values : (n,) array
        NaN: not known of that frame.
    """
    by_turn = [_by_turn(methods, method, values) for method in np.unique(methods)]
    first = by_turn[0]
    compared = []
    for index, (name, means) in enumerate(zip(names, by_turn, strict=True)):
        length = min(len(means), len(first))
        difference = None if index == 0 else _mean(means[:length] - first[:length], len(by_turn) - 1)
        compared.append(MethodDifference(name, _mean(means), difference))
    return compared


def _by_turn(methods: NDArray[np.int64], method: int, values: Floats) -> Floats:
    """Return the mean of each turn of a method: of frames of its, one after the other; NaN without any."""
    number = np.cumsum(np.concatenate([[0], np.diff(methods) != 0]))[methods == method]
    method_values = values[methods == method]
    _, turn = np.unique(number, return_inverse=True)
    kept = np.isfinite(method_values)
    count = np.bincount(turn, weights=kept)
    sums = np.bincount(turn, weights=np.where(kept, method_values, 0.0))
    return np.asarray(np.divide(sums, count, out=np.full(len(count), np.nan), where=count > 0))


def _mean(values: Floats, comparisons: int = 1) -> Estimate:
    kept = values[np.isfinite(values)]
    return mean_by_blocks(kept, _TURNS_TOGETHER, comparisons=comparisons) if kept.size else UNKNOWN
