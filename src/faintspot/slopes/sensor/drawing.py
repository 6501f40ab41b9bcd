"""Maps of values by sub-aperture, and marks on pictures: outlines and arrows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.plots import COLOUR_MAP, FLUX_GREY, GREY, WIDTH, Mark, colour_bar
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_outlines, lenslet_pitch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

MOST_WITH_GAPS = 600
"""Number of sub-apertures above which gaps and outlines are left out, because they cause a moiré pattern."""


def subaperture_shapes(layout: Layout) -> Floats:
    """Return the corners of each lenslet's square or hexagon in frame pixels, (n, 4 or 6, 2)."""
    return lenslet_outlines(layout, 0.96 if len(layout) <= MOST_WITH_GAPS else 1.0)


@dataclass(frozen=True)
class Outlines:
    """Polygons that are not filled."""

    corners: Floats | Sequence[Floats]
    """(n, corners, 2)."""
    style: Mapping[str, Any]
    """Options of Matplotlib's `PolyCollection`."""

    def draw(self, axes: Axes) -> None:
        """Draw them."""
        from matplotlib.collections import PolyCollection

        axes.add_collection(PolyCollection(list(self.corners), **{"facecolors": "none", **self.style}))


@dataclass(frozen=True)
class Arrows:
    """Arrows from points, (n, 2), by vectors, (n, 2)."""

    start: Floats
    vector: Floats
    style: Mapping[str, Any]
    """Options of Matplotlib's `quiver`."""
    key: float = 0.0
    """Length [px] of the arrow that is shown as the scale; 0 shows none."""

    def draw(self, axes: Axes) -> None:
        """Draw them."""
        arrows = axes.quiver(*self.start.T, *self.vector.T, angles="xy", scale_units="xy", **self.style)
        if self.key:
            options: dict[str, Any] = {"labelpos": "E", "coordinates": "axes"}
            axes.quiverkey(arrows, 0.87, -0.1, self.key, f"{self.key:g} px", **options)


@dataclass(frozen=True)
class Map:
    """Values of sub-apertures at their places; NaN is an empty outline, and no values are outlines alone."""

    layout: Layout
    values: NDArray[Any] | None = None
    unit: str = ""
    """Label of the colour bar."""
    title: str = ""
    limits: tuple[float, float] = (0.0, 1.0)
    marks: Sequence[Mark] = field(default_factory=tuple)
    y: str = "row (px)"
    share: float = 1.0

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        from matplotlib.collections import PolyCollection

        shapes = subaperture_shapes(self.layout)
        if self.values is not None:
            known = np.isfinite(self.values)
            empty = {"facecolors": "white", "edgecolors": GREY, "linewidths": 0.6}
            Outlines(shapes[~known], empty).draw(axes)
            filled = PolyCollection(list(shapes[known]), array=self.values[known], cmap=COLOUR_MAP, lw=0)
            filled.set_antialiased(len(self.layout) <= MOST_WITH_GAPS)
            filled.set_clim(*self.limits)
            axes.add_collection(filled)
            colour_bar(axes, filled, self.unit)
        elif len(self.layout) <= MOST_WITH_GAPS:  # of more, outlines would hide the marks
            Outlines(shapes, {"facecolors": "#f6f6f6", "edgecolors": FLUX_GREY}).draw(axes)
        for mark in self.marks:
            mark.draw(axes)
        margin = 0.25 * lenslet_pitch(self.layout)
        low, high = shapes.min(axis=(0, 1)) - margin, shapes.max(axis=(0, 1)) + margin
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set(xlabel="column (px)", ylabel=self.y, title=self.title)


def map_height(layout: Layout, columns: int) -> float:
    """Return the height of a row of maps [inch], as the sensor's shape asks for."""
    width, height = np.ptp(subaperture_shapes(layout).reshape(-1, 2), axis=0)
    return float(min(max(0.8 * WIDTH / max(columns, 2) * height / width, 2.5), 6.5) + 0.6)
