"""Picture of the command that would flatten a wavefront."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import GREY, METHOD_COLOURS, WIDTH, colour_bar, new_figure, styled
from faintspot.loop.control.flattening import Flattening
from faintspot.slopes.sensor.drawing import place_axes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_pitch
from faintspot.slopes.wavefront.figure import wavefront_map
from faintspot.slopes.wavefront.fit import Wavefront, total

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_LEAST_APART = 0.2  # sub-apertures between neighbours: closer positions are not those of actuators


@styled
def flattening_figure(flat: Flattening, before: Wavefront, after: Wavefront, layout: Layout) -> Figure:
    """Draw the wavefront before and after the command, and the command over actuators and pupil.

    Parameters
    ----------
    flat : Flattening
    before, after : Wavefront
        Fits to the slopes, and to the slopes with those of the command.
    layout : Layout
    """
    figure = new_figure(WIDTH, 9.6)
    above, below = figure.subfigures(2, 1, squeeze=False)[:, 0]
    largest = float(np.nanmax(np.abs(before.sheet())))
    panels = above.subplots(1, 2)
    for axes, wavefront, when in zip(panels, (before, after), ("measured", "with the command"), strict=True):
        wavefront_map(axes, wavefront, layout, largest=largest)
        axes.set_title(f"{when}: {float(total(wavefront.mean)):.3g} {before.unit} rms", fontsize=12)
    places = _places(flat.interaction, layout)
    panels = below.subplots(1, 1 if places is None else 2, squeeze=False)[0]
    _bars(panels[0], flat)
    if places is not None:
        _map(panels[1], flat, places, layout)
    figure.suptitle("Command that would flatten the mean wavefront", fontsize=14)
    return figure


def _places(interaction: Floats, layout: Layout) -> Floats | None:
    """Return where each actuator moves spots, (actuators, 2); None if places do not tell them apart."""
    squares = np.square(interaction).reshape(2, len(layout), -1).sum(axis=0)
    weights = squares / np.maximum(squares.sum(axis=0), np.finfo(float).tiny)
    places: Floats = weights.T @ layout.centres
    apart = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    close = apart.min(axis=1) < _LEAST_APART * lenslet_pitch(layout)
    return None if len(places) < 2 or close.mean() > 0.1 else places


def _bars(axes: Axes, flat: Flattening) -> None:
    axes.bar(np.arange(len(flat.command)), flat.command, 0.8, color=METHOD_COLOURS[1])
    axes.axhline(0, color="black", lw=0.8)
    if flat.stroke is not None:
        for limit in (-flat.stroke, flat.stroke):
            axes.axhline(limit, color=GREY, lw=1, ls="--")
    axes.set(title="command", xlabel="actuator", ylabel="unit of the interaction matrix")


def _map(axes: Axes, flat: Flattening, places: Floats, layout: Layout) -> None:
    largest = float(np.abs(flat.command).max()) or 1.0
    place_axes(axes, layout)
    # Points as large as the actuators are apart, roughly: the pupil is 3 inches wide.
    size = (0.7 * 72 * 3.0 / np.sqrt(len(places))) ** 2
    x, y = places.T
    dots = axes.scatter(x, y, c=flat.command, s=size, cmap="RdBu_r", vmin=-largest, vmax=largest)
    dots.set_edgecolor(GREY)
    axes.set_title("where each actuator moves spots")
    colour_bar(axes, dots, "command")
