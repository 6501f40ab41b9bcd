"""Picture of a layout: its windows and their numbers on a frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.files import write_atomically
from faintspot.base.report.plots import colour_bar, limits_of, new_figure, png, styled
from faintspot.base.statistics import MAD_TO_STD
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from matplotlib.colors import FuncNorm
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_WINDOW, _DOUBTFUL = "#E69F00", "#56B4E9"
_MOST_NUMBERED = 1500
_MOST_PIXELS = 1400  # a side of the frame; of more, pixels are averaged rather than left out


@styled
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
        x, y of spots outside all windows, drawn as circles.
    doubtful : (n_subapertures,) array of bool, optional
        Sub-apertures whose windows are drawn in another colour.

    Raises
    ------
    InputError
        When the frame is not of the layout's shape or the file cannot be written.
    """
    array = np.asarray(frame, dtype=np.float64)
    if array.ndim == 3:
        array = array.mean(axis=0)
    inside = layout.images(array)
    marked = np.zeros(len(layout), bool) if doubtful is None else np.asarray(doubtful, bool)
    figure = _layout_figure(array, inside, layout, np.reshape(outside, (-1, 2)), marked)
    write_atomically(path, png(figure, tight=False))


def _layout_figure(
    array: Floats, inside: Floats, layout: Layout, outside: Floats, doubtful: NDArray[np.bool_]
) -> Figure:
    from matplotlib import patheffects
    from matplotlib.collections import PolyCollection

    n_rows, n_columns = array.shape
    side = 12.0
    figure = new_figure(side, min(max(0.9 * side * n_rows / n_columns, 3.0), 2 * side) + 0.9)
    axes = figure.subplots()
    smooth = "nearest" if max(array.shape) <= _MOST_PIXELS else "antialiased"
    image = axes.imshow(array, cmap="gray", norm=asinh_stretch(array, inside), interpolation=smooth)
    colour_bar(axes, image, "frame's units")
    points = 72 * side * 0.85 * layout.window[1] / n_columns  # a window's width in points
    boxes, line = _window_outlines(layout), min(max(points / 14, 0.2), 0.9)  # lines never hide the spots
    colours = [_DOUBTFUL if marked else _WINDOW for marked in doubtful]
    axes.add_collection(PolyCollection(boxes, facecolors="none", edgecolors=colours, linewidths=line))
    axes.scatter(
        outside[:, 0],
        outside[:, 1],
        s=(0.8 * points) ** 2,
        facecolors="none",
        edgecolors=_DOUBTFUL,
        linewidths=1.0,
    )
    axes.set_xlabel("column (px)")
    axes.set_ylabel("row (px)")
    pitch = "" if layout.pitch_px is None else f", pitch {layout.pitch_px:.2f} px"
    plural = "" if len(layout) == 1 else "s"
    axes.set_title(
        f"{len(layout)} sub-aperture{plural} of {layout.window[0]} x {layout.window[1]} px, "
        f"{layout.geometry}{pitch}, angle {layout.angle_deg:.2f}°"
    )
    # Numbers, which take long, come when the layout is found, so that they are drawn once.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    font = min(points / 3.0, 13.0)
    if font >= 4 and len(layout) <= _MOST_NUMBERED:
        for number, (row, column) in enumerate(layout.corners):
            axes.text(
                column - 0.5 + 0.06 * layout.window[1],
                row - 0.5 + 0.95 * layout.window[0],
                str(number),
                color=_WINDOW,
                fontsize=font,
                va="top",
                clip_on=True,
                path_effects=[patheffects.withStroke(linewidth=1.6, foreground="black")],
            )
    return figure


def asinh_stretch(array: Floats, inside: Floats) -> FuncNorm:
    """Return an asinh stretch around the sky level, in units of its noise; blind to hot and bad pixels."""
    from matplotlib.colors import FuncNorm

    good = array[np.isfinite(array)]
    sky = float(np.median(good)) if good.size else 0.0
    noise = MAD_TO_STD * float(np.median(np.abs(good - sky))) if good.size else 0.0
    low, high = limits_of(inside, percent=99.5)
    low, high = min(low, sky - 2 * noise), max(high, sky + 5 * noise)
    if not high > low:
        low, high = low - 1.0, low + 1.0
    # Linear over the noise, logarithmic over the spots; never linear in less than a twentieth of the range.
    unit = max(3 * noise, 0.05 * (high - low))
    return FuncNorm(
        (lambda v: np.arcsinh((v - sky) / unit), lambda u: sky + unit * np.sinh(u)), vmin=low, vmax=high
    )


def _window_outlines(layout: Layout) -> list[Any]:
    height, width = layout.window
    ring = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    return list(layout.corners[:, None, ::-1] + ring)
