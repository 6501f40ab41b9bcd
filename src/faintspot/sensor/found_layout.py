"""A layout found in a frame, and what was left out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.sensor.layout import Layout
from faintspot.sensor.lenslets import LensletGrid
from faintspot.sensor.windows import find_windows


@dataclass(frozen=True)
class FoundLayout:
    """A layout found in a frame, and what was left out of it.

    Parameters
    ----------
    layout : Layout
        The lit sub-apertures whose windows lie within the frame.
    lenslets : LensletGrid
        All lit lenslets, those at the edge too.
    cut : (n, 2) array
        x, y of the lit lenslets that were left out because their window leaves the frame, px.
    """

    layout: Layout
    lenslets: LensletGrid
    cut: NDArray[np.float64]


def find_layout(frame: ArrayLike, **options: Any) -> FoundLayout:
    """Find the sub-apertures of a frame, and say which were left out; see `Layout.from_frame`.

    Raises
    ------
    InputError
        When no regular array of spots is found, or no window lies within the frame.
    """
    found = find_windows(frame, **options)
    return FoundLayout(Layout.of_windows(found), found.lenslets, found.lenslets.centres[~found.within])
