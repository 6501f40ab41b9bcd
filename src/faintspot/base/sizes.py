"""Size limits of tables and frames, checked before memory is allocated."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

from faintspot.base.errors import InputError

MOST_NUMBERS = 1 << 28
"""Maximum number of values, 1 GB in float32: a frame of 16,384 x 16,384 pixels."""


MOST_TEXT_BYTES = 1 << 26
"""Maximum size of metadata (JSON text)."""


def check_size(
    name: str, sides: Sequence[int], most: int = MOST_NUMBERS, what: str = "", hint: str = ""
) -> None:
    """Raise an error for an array of more than `most` numbers.

    Parameters
    ----------
    name : str
        Name in messages.
    sides : sequence of int
        Shape of the array, or counts to multiply.
    most : int
    what : str
        Unit of the count, such as "pixels".
    hint : str
        Advice on what to change.

    Raises
    ------
    InputError
        If it is larger.
    """
    if math.prod(sides) > most:
        name = f"{name} = {' x '.join(map(str, sides))}"
        raise InputError(f"expected at most {most:,} {what or 'numbers'}{hint and f'; {hint}'}", name=name)


def check_bytes(name: object, total: int, most: int, what: str) -> None:
    """Raise an error if `what`, read from a file, needs more than `most` bytes of memory.

    Raises
    ------
    InputError
        If it does.
    """
    if total > most:
        size, limit = f"{total / 2**20:,.0f} MiB", f"{most / 2**20:,.0f} MiB"
        raise InputError(f"{name}: needs {size} of memory, expected {what} of at most {limit}")


def memory_bytes() -> int:
    """Return the memory of the machine in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
