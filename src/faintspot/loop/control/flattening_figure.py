"""Picture of the command that would flatten a wavefront."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from faintspot.base.report.plots import METHOD_COLOURS, Line, Panel, plot
from faintspot.loop.control.flattening import Flattening
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront.figure import wavefront_map
from faintspot.slopes.wavefront.fit import Wavefront

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def flattening_figure(flat: Flattening, before: Wavefront, after: Wavefront, layout: Layout) -> Figure:
    """Draw the wavefront before and after the command, and the command of each actuator.

    Parameters
    ----------
    flat : Flattening
    before, after : Wavefront
        Fits to the slopes, and to the slopes with those of the command.
    layout : Layout
    """
    largest = float(np.nanmax(np.abs(before.sheet())))
    cases = {"measured": before, "with the command": after}
    maps = [wavefront_map(wavefront, layout, when, largest=largest) for when, wavefront in cases.items()]
    style = {"color": METHOD_COLOURS[1], "drawstyle": "steps-mid", "marker": ".", "lw": 1}
    limits = [] if flat.stroke is None else [-flat.stroke, flat.stroke]
    levels = {0.0: {}, **{limit: {"ls": "--", "label": "stroke limit"} for limit in limits}}
    line, unit = (
        Line("command", np.arange(len(flat.command)), flat.command, style=style),
        "interaction matrix",
    )
    panel = Panel([line], "actuator", f"command (unit of the {unit})", levels=levels, share=2)
    return plot([maps, [panel]], 9.6, heading="Command that would flatten the mean wavefront")
