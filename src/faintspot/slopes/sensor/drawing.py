"""Maps of values by sub-aperture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.plots import COLOUR_MAP, GREY, colour_bar
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_outlines, lenslet_pitch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_WITH_GAPS = 600
"""Number of sub-apertures above which gaps and outlines are left out, because they cause a moiré pattern."""


def subaperture_shapes(layout: Layout) -> NDArray[np.float64]:
    """Return the corners of each lenslet's square or hexagon in frame pixels, (n, 4 or 6, 2)."""
    return lenslet_outlines(layout, 0.96 if len(layout) <= MOST_WITH_GAPS else 1.0)


class Map(NamedTuple):
    """One value per sub-aperture; NaN is an empty outline."""

    values: NDArray[Any]
    label: str
    """Label of the colour bar, with the unit."""
    title: str
    limits: tuple[float, float]


def subaperture_map(axes: Axes, layout: Layout, shown: Map) -> None:
    """Draw the values of sub-apertures at their positions."""
    from matplotlib.collections import PolyCollection

    shapes = subaperture_shapes(layout)
    known = np.isfinite(shown.values)
    empty = PolyCollection(list(shapes[~known]), facecolors="white", edgecolors=GREY, linewidths=0.6)
    filled = PolyCollection(list(shapes[known]), array=shown.values[known], cmap=COLOUR_MAP, linewidths=0)
    filled.set_antialiased(len(layout) <= MOST_WITH_GAPS)
    filled.set_clim(*shown.limits)
    axes.add_collection(empty)
    axes.add_collection(filled)
    place_axes(axes, layout)
    axes.set_title(shown.title)
    colour_bar(axes, filled, shown.label)


def place_axes(axes: Axes, layout: Layout) -> None:
    """Set the limits of axes in frame pixels so that all sub-apertures are visible."""
    shapes = subaperture_shapes(layout).reshape(-1, 2)
    margin = 0.25 * lenslet_pitch(layout)
    low, high = shapes.min(axis=0) - margin, shapes.max(axis=0) + margin
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("column (px)")
    axes.set_ylabel("row (px)")
