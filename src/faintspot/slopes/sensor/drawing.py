"""Maps of values by sub-aperture, outlines and arrows on pictures, and the picture of a layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.files import write_atomically
from faintspot.base.report.plots import (
    COLOUR_MAP,
    FLUX_GREY,
    GREY,
    WIDTH,
    Labels,
    Line,
    Mark,
    Picture,
    colour_bar,
    draw,
    limits_of,
    plot,
    png,
)
from faintspot.base.statistics import mad_std
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_outlines, lenslet_pitch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import FuncNorm


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


_WINDOW, _DOUBTFUL = "#E69F00", "#56B4E9"
_MOST_NUMBERED = 1500
_MOST_PIXELS = 1400  # a side of the frame; of more, pixels are averaged rather than left out
_SIDE, _NEW_SIDE = 12.0, 4.0  # inch: of the picture's file; of new axes


def layout_picture(
    frame: ArrayLike,
    layout: Layout,
    path: str | Path,
    *,
    outside: ArrayLike = (),
    doubtful: ArrayLike | None = None,
) -> None:
    """Write a PNG picture of a frame with the sub-apertures' windows and numbers drawn on it.

    The brightness follows asinh of the flux above the sky, cut at the 99.5th percentile of the windows'
    pixels, so hot pixels neither hide the spots nor set the scale.

    Parameters
    ----------
    frame : (h, w) or (n, h, w) array
        Several are averaged.
    layout : Layout
    path : str or Path
        Replaced when it exists.
    outside : (m, 2) array
        x, y of lit spots that are in no sub-aperture, drawn as circles.
    doubtful : (n_subapertures,) array of bool, optional
        Sub-apertures whose windows are drawn in another colour.

    Raises
    ------
    InputError
        When the frame is not of the layout's shape or the file cannot be written.
    """
    picture = _picture(frame, layout, outside, doubtful)
    n_rows, n_columns = picture.image.shape
    high = min(max(0.9 * _SIDE * n_rows / n_columns, 3.0), 2 * _SIDE) + 0.9
    figure = plot([[picture]], high, width=_SIDE, legend="")
    write_atomically(path, png(figure, tight=False))


def plot_layout(layout: Layout, frame: ArrayLike | None, axes: Axes | None) -> Axes:
    """Draw what `Layout.plot` returns."""
    if frame is None:
        return draw([[Map(layout)]], axes)  # type: ignore[no-any-return]
    width = _NEW_SIDE if axes is None else axes.get_window_extent().width / axes.figure.dpi
    return draw([[_picture(frame, layout, side=width)]], axes)  # type: ignore[no-any-return]


def _picture(
    frame: ArrayLike,
    layout: Layout,
    outside: ArrayLike = (),
    doubtful: ArrayLike | None = None,
    side: float = 0.85 * _SIDE,
) -> Picture:
    """Return the picture of a layout, for axes `side` inches wide; see `layout_picture`."""
    from matplotlib import patheffects

    array = np.asarray(frame, dtype=np.float64)
    if array.ndim == 3:
        array = array.mean(axis=0)
    n_columns = array.shape[1]
    (height, width), corners = layout.window, layout.corners[:, ::-1] - 0.5
    points = 72 * side * width / n_columns  # a window's width in points
    marked = np.zeros(len(layout), bool) if doubtful is None else np.asarray(doubtful, bool)
    windows = {
        "edgecolors": np.where(marked, _DOUBTFUL, _WINDOW),
        "linewidths": min(max(points / 14, 0.2), 0.9),  # lines never hide the spots
    }
    ring = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    circle = {"ls": "", "marker": "o", "ms": 0.8 * points, "mfc": "none", "mec": _DOUBTFUL}
    marks: list[Mark] = [
        Outlines(corners[:, None] + ring, windows),
        Line.of("", np.reshape(outside, (-1, 2)), circle),
    ]
    if points >= 12 and len(layout) <= _MOST_NUMBERED:
        around = [patheffects.withStroke(linewidth=1.6, foreground="black")]
        style = {"color": _WINDOW, "fontsize": min(points / 3.0, 13.0), "va": "top", "path_effects": around}
        places = corners + np.array([0.06 * width, 0.95 * height])
        marks.append(Labels(places, [str(number) for number in range(len(layout))], style))
    pitch = "" if layout.pitch_px is None else f", pitch {layout.pitch_px:.2f} px"
    title = (
        f"{len(layout)} sub-aperture{'' if len(layout) == 1 else 's'} of {height} x {width} px, "
        f"{layout.geometry}{pitch}, angle {layout.angle_deg:.2f}°"
    )
    style = {
        "cmap": "gray",
        "norm": asinh_stretch(array, layout.images(array)),
        "interpolation": "nearest" if max(array.shape) <= _MOST_PIXELS else "antialiased",
    }
    return Picture(array, "frame's units", title, style=style, marks=marks)


def asinh_stretch(array: Floats, inside: Floats) -> FuncNorm:
    """Return an asinh stretch around the sky level, in units of its noise; blind to hot and bad pixels."""
    from matplotlib.colors import FuncNorm

    good = array[np.isfinite(array)]
    sky = float(np.median(good)) if good.size else 0.0
    noise = mad_std(good) if good.size else 0.0
    low, high = limits_of(inside, percent=99.5)
    low, high = min(low, sky - 2 * noise), max(high, sky + 5 * noise)
    if not high > low:
        low, high = low - 1.0, low + 1.0
    # Linear over the noise, logarithmic over the spots; never linear in less than a twentieth of the range.
    unit = max(3 * noise, 0.05 * (high - low))
    return FuncNorm(
        (lambda v: np.arcsinh((v - sky) / unit), lambda u: sky + unit * np.sinh(u)), vmin=low, vmax=high
    )
