"""One publication of a stream."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

LARGEST_NUMBER = 2**63 - 1
"""Largest frame number."""


class Publication(NamedTuple):
    """Values that were published together."""

    values: NDArray[Any]
    number: int
    """Frame number given by the producer."""
    total: int
    """Number of publications up to this one."""
