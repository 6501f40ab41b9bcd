"""Figures of a wavefront: maps with and without tip and tilt, and its coefficients."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.page import FigureWithData
from faintspot.base.report.plots import GREY, METHOD_COLOURS, Drawing, Line, Panel, Picture, draw, plot
from faintspot.slopes.sensor.drawing import Outlines
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_outlines
from faintspot.slopes.wavefront.certificate import Drift
from faintspot.slopes.wavefront.fit import Wavefront
from faintspot.slopes.wavefront.zernike import mode_name, osa_index

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_OUTLINED = 1500
_MOST_NAMED = 45  # modes of a panel


def wavefront_figure(
    wavefront: Wavefront, layout: Layout, name: str, *, file: str = "wavefront"
) -> FigureWithData:
    """Draw the mean wavefront over the pupil and its coefficients with standard errors."""
    several = int(np.count_nonzero(wavefront.fitted)) > 1
    subject = "mean wavefront" if several else "wavefront"
    maps = (
        wavefront_map(wavefront, layout, subject),
        wavefront_map(wavefront, layout, f"{subject} without tip and tilt", tilt=False),
    )
    higher = max(len(wavefront.modes) - 2, 0)
    share = 2 / (1 + min(max(3, higher / 2), 9)) if higher else 2.0
    panels = [_coefficients(wavefront, slice(0, 2), several, share)]
    if higher:
        panels.append(_coefficients(wavefront, slice(2, None), several, 2 - share))
    x, y = wavefront.pupil.centre_px
    caption = (
        f"{subject.capitalize()} over the lit pupil, in the frame's directions, with the sub-apertures and "
        f"the disk of the modes outlined (centre {x:.1f}, {y:.1f} px, radius {wavefront.pupil.radius_px:.1f} "
        "px); it increases in the direction in which spots are displaced. Below: its "
        "coefficients ± standard error, with the names of the modes and their indices (Noll | OSA/ANSI)"
        + (", and in grey the rms of each over the frames (motion and noise)." if several else ".")
    )
    rows: list[list[Drawing]] = [[*maps], [*panels]]
    legend = "outside lower center" if several else ""
    return FigureWithData.of(file, f"Wavefront of {name}", caption, rows, 11.2, heading=name, legend=legend)


def plot_wavefront(wavefront: Wavefront, axes: Axes | None, *, tilt: bool) -> Axes:
    """Draw what `Wavefront.plot` returns."""
    several = int(np.count_nonzero(wavefront.fitted)) > 1
    title = ("mean wavefront" if several else "wavefront") + (" without tip and tilt" if not tilt else "")
    return draw([[wavefront_map(wavefront, None, title, tilt=tilt)]], axes)  # type: ignore[no-any-return]


def wavefront_map(
    wavefront: Wavefront, layout: Layout | None, title: str, *, tilt: bool = True, largest: float = 0.0
) -> Picture:
    """Return the mean wavefront at its position in the frame, with sub-apertures outlined.

    Colours go to `largest` on both sides; 0: to the largest value. Without a layout, the sub-apertures are
    those with valid slopes.
    """
    sheet, pupil, unit = wavefront.sheet(tilt=tilt), wavefront.pupil, wavefront.unit
    (x, y), radius = pupil.centre_px, pupil.radius_px
    largest = largest or float(np.nanmax(np.abs(sheet))) or 1.0
    half = radius * len(sheet) / (len(sheet) - 1)  # the outermost points are within the image
    style = {
        "cmap": "RdBu_r",
        "vmin": -largest,
        "vmax": largest,
        "extent": (x - half, x + half, y - half, y + half),
    }
    outline = {"edgecolors": "#00000030", "linewidths": 0.6}
    lenslets = radius * wavefront.outlines + (x, y) if layout is None else lenslet_outlines(layout)
    if len(lenslets) > _MOST_OUTLINED:
        lenslets = lenslets[:0]
    angle, margin = np.linspace(0, 2 * np.pi, 200), 1.12 * radius
    circle = Line(
        "", x + radius * np.cos(angle), y + radius * np.sin(angle), style={"color": "black", "lw": 0.8}
    )
    ranges: dict[str, Any] = {
        "background": "white",
        "x_range": (x - margin, x + margin),
        "y_range": (y - margin, y + margin),
    }
    return Picture(sheet, unit, title, style=style, marks=[Outlines(lenslets, outline), circle], **ranges)


def _coefficients(wavefront: Wavefront, part: slice, several: bool, share: float) -> Panel:
    modes, errors = wavefront.modes[part], np.nan_to_num(wavefront.mean_standard_error[part])
    point = {"ls": "", "marker": "o", "ms": 5, "color": METHOD_COLOURS[1], "ecolor": "black", "capsize": 2}
    label = "mean over the frames ± standard error" if several else "coefficient ± standard error"
    lines = [Line(label, modes, wavefront.mean[part], errors, point)]
    if several:
        of_frames = {"ls": "", "marker": "_", "ms": 9, "mew": 3, "color": GREY}
        lines.append(Line("rms over the frames", modes, wavefront.rms_of_frames[part], style=of_frames))
    named = modes[:: -(-len(modes) // _MOST_NAMED)].tolist()
    names = {float(j): f"{mode_name(j)}   Z{j} | {osa_index(j)}" for j in named}
    unit, ends = f"coefficient ({wavefront.unit})", (modes[0] - 0.7, modes[-1] + 0.7)
    return Panel(lines, "", unit, x_range=ends, levels={0.0: {}}, names=names, share=share)


def drift_figure(found: Drift, wavefront: Wavefront, name: str) -> Figure:
    """Draw each mode's change against time with the fitted line, four modes in a panel."""
    since, panels = found.time - found.time.mean(), []
    change = found.mean - found.mean.mean(axis=0)
    for start in range(0, len(wavefront.modes), len(METHOD_COLOURS)):
        lines = []
        for number, colour in zip(range(start, len(wavefront.modes)), METHOD_COLOURS, strict=False):
            point = {"ls": "", "marker": "o", "ms": 4, "color": colour, "capsize": 2}
            errors, label = found.standard_error[:, number], f"Z{wavefront.modes[number]}"
            lines.append(Line(label, found.time, change[:, number], errors, point))
            lines.append(Line("", found.time, found.rate[number] * since, style={"color": colour, "lw": 1}))
        panels.append(Panel(lines, f"time ({found.time_unit})", f"change ({wavefront.unit})", legend=True))
    rows = [panels[start : start + 2] for start in range(0, len(panels), 2)]
    return plot(rows, 0.6 + 2.8 * len(rows), heading=f"Drift of {name}", legend="")
