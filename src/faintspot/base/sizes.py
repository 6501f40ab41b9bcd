"""How much a table or a frame may hold: more is a mistake, refused before it takes the memory."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

from faintspot.base.errors import InputError

MOST_NUMBERS = 1 << 28
"""A gigabyte of float32: a frame of 16,384 x 16,384 pixels."""


MOST_TEXT_BYTES = 1 << 26
"""Of metadata, JSON text."""


def check_size(
    name: str, sides: Sequence[int], most: int = MOST_NUMBERS, what: str = "", hint: str = ""
) -> None:
    """Refuse an array of more than `most` numbers.

    Parameters
    ----------
    name : str
        What messages call it.
    sides : sequence of int
        Its shape, or the counts that multiply.
    most : int
    what : str
        What its numbers are, such as "pixels".
    hint : str
        What the user may change.

    Raises
    ------
    InputError
        When it is larger.
    """
    if math.prod(sides) > most:
        shape = " x ".join(str(side) for side in sides)
        raise InputError(
            f"{name} = {shape}: expected at most {most:,} {what or 'numbers'}{hint and f'; {hint}'}"
        )


def check_bytes(name: object, total: int, most: int, what: str) -> None:
    """Refuse `what` is read from a file when it takes more than `most` bytes of memory.

    Raises
    ------
    InputError
        When it does.
    """
    if total > most:
        size, limit = f"{total / 2**20:,.0f} MiB", f"{most / 2**20:,.0f} MiB"
        raise InputError(f"{name}: takes {size} of memory, expected {what} of at most {limit}")


def memory_bytes() -> int:
    """Return how much memory the machine has."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
