"""Images whose colours are equal, as software writes them for grey cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError

CHANNELS = ("red", "green", "blue")
EQUAL_COLOURS = "red, green and blue are equal, and read as grey"
"""Note about such an image."""


def grey(name: str, values: NDArray[np.generic], *, selectable: bool = True) -> NDArray[Any]:
    """Return the first of equal channels (..., h, w, 2 to 4); the second or fourth may be transparency.

    Raises
    ------
    InputError
        If the colours differ.
    """
    colours = values[..., : 3 if values.shape[-1] > 2 else 1]
    first = colours[..., :1]
    if (colours != first).any():
        part = 100 * float((colours != first).any(axis=-1).mean())
        way = (
            f"choose one with {name}:green (or red, blue)"
            if selectable
            else "save one of the colours in grey"
        )
        raise InputError(
            f"{name}: expected a grey image, its colours differ in {part:.3g} % of the pixels; {way}"
        )
    return np.ascontiguousarray(first[..., 0])


def one_channel(values: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    """Return the channel of this name of an image (h, w, 2 to 4)."""
    return np.ascontiguousarray(values[..., min(CHANNELS.index(name), values.shape[-1] - 2)])
