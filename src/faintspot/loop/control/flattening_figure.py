"""Picture of the command that would flatten a wavefront."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from faintspot.base.report.plots import GREY, METHOD_COLOURS, WIDTH, new_figure, styled
from faintspot.loop.control.flattening import Flattening
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront.figure import wavefront_map
from faintspot.slopes.wavefront.fit import Wavefront, total

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def flattening_figure(flat: Flattening, before: Wavefront, after: Wavefront, layout: Layout) -> Figure:
    """Draw the wavefront before and after the command, and the command of each actuator.

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
    _bars(below.subplots(), flat)
    figure.suptitle("Command that would flatten the mean wavefront", fontsize=14)
    return figure


def _bars(axes: Axes, flat: Flattening) -> None:
    axes.bar(np.arange(len(flat.command)), flat.command, 0.8, color=METHOD_COLOURS[1])
    axes.axhline(0, color="black", lw=0.8)
    if flat.stroke is not None:
        for limit in (-flat.stroke, flat.stroke):
            axes.axhline(limit, color=GREY, lw=1, ls="--")
    axes.set(title="command", xlabel="actuator", ylabel="unit of the interaction matrix")
