"""Figures of a wavefront: maps with and without tip and tilt, its coefficients, and a zonal map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.plots import FLUX_GREY, METHOD_COLOURS, WIDTH, colour_bar, new_figure, styled
from faintspot.base.statistics import rms
from faintspot.slopes.sensor.drawing import Map, subaperture_map
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import Pupil, lenslet_outlines
from faintspot.slopes.wavefront.fit import Floats, Wavefront, total
from faintspot.slopes.wavefront.words import mode_records
from faintspot.slopes.wavefront.zernike import mode_name, osa_index
from faintspot.slopes.wavefront.zonal import ZonalMap, compared

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIGNED_COLOURS = "RdBu_r"
_MOST_OUTLINED = 1500


@styled
def wavefront_figure(
    wavefront: Wavefront, layout: Layout, name: str, *, file: str = "wavefront"
) -> FigureWithData:
    """Draw the mean wavefront over the pupil and its coefficients with standard errors."""
    several = int(np.count_nonzero(wavefront.fitted)) > 1
    figure = new_figure(WIDTH, 11.2)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(5.6, 5.6))[:, 0]
    subject = "mean wavefront" if several else "wavefront"
    for axes, tilt in zip(above.subplots(1, 2), (True, False), strict=True):
        rms = float(total(wavefront.mean, tilt=tilt))
        title = subject if tilt else f"{subject} without tip and tilt"
        wavefront_map(axes, wavefront, layout, tilt=tilt)
        axes.set_title(f"{title}: {rms:.3g} {wavefront.unit} rms", fontsize=12)
    has_higher = len(wavefront.modes) > 2
    widths = {"width_ratios": (1, max(3, min(len(wavefront.modes) / 2, 9)))} if has_higher else {}
    panels = below.subplots(1, 2 if has_higher else 1, squeeze=False, **widths)[0]
    for axes, part in zip(panels, (slice(0, 2), slice(2, None)), strict=False):
        _bars(axes, wavefront, part, several)
    panels[0].set_ylabel(f"coefficient ({wavefront.unit})")
    if several:
        handles, labels = panels[-1].get_legend_handles_labels()
        below.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    above.suptitle(name, fontsize=14)
    caption = (
        f"{subject.capitalize()} over the disk of the pupil, in the frame's directions, with the "
        "illuminated sub-apertures outlined; it increases in the direction in which spots "
        "are displaced. Below: its coefficients in "
        "Noll's order ± standard error, with the names of the modes and their indices (Noll | OSA/ANSI)"
        + (", and in grey the rms of each over the frames (motion and noise)." if several else ".")
    )
    records = mode_records(wavefront)
    rows = [
        (*record.values(), of_frames, wavefront.unit)
        for record, of_frames in zip(records, wavefront.rms_of_frames, strict=True)
    ]
    header = (*records[0], "rms_of_frames", "unit")
    return FigureWithData(file, f"Wavefront of {name}", caption, figure, header, rows)


def wavefront_map(
    axes: Axes, wavefront: Wavefront, layout: Layout, *, tilt: bool = True, largest: float = 0.0
) -> None:
    """Draw the mean wavefront at its position in the frame, with the illuminated sub-apertures outlined.

    Colours go to `largest` on both sides; 0: to the largest value.
    """
    sheet = wavefront.sheet(tilt=tilt)
    _map(axes, sheet, wavefront.pupil, layout, wavefront.unit, largest=largest)


@styled
def zonal_figure(zonal: ZonalMap, wavefront: Wavefront, layout: Layout, name: str) -> Figure:
    """Draw a zonal map, the wavefront of the modes, their difference, and standard errors."""
    figure = new_figure(WIDTH, 10.4)
    panels = figure.subplots(2, 2).ravel()
    sheets = compared(zonal, wavefront)
    largest = max(float(np.nanmax(np.abs(sheet))) for sheet in list(sheets.values())[:2])
    for axes, (title, sheet), limit in zip(panels, sheets.items(), (largest, largest, 0.0), strict=False):
        _map(axes, sheet, zonal.pupil, layout, zonal.unit, largest=limit, reach=zonal.reach)
        axes.set_title(f"{title}: {rms(sheet):.3g} {zonal.unit} rms", fontsize=12)
    error, largest = rms(zonal.standard_errors), float(np.nan_to_num(zonal.standard_errors).max())
    title = f"standard error: {error:.3g} {zonal.unit} rms" if error > 0 else "standard error: unknown"
    shown = Map(zonal.standard_errors, zonal.unit, title, (0.0, largest or 1.0))
    subaperture_map(panels[3], layout, shown)
    figure.suptitle(name, fontsize=14)
    return figure


def _map(
    axes: Axes,
    sheet: Floats,
    pupil: Pupil,
    layout: Layout,
    unit: str,
    *,
    largest: float = 0.0,
    reach: float = 1.0,
) -> None:
    """Draw a map whose outermost points are `reach` radii of the pupil from its centre."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle

    (x, y), radius = pupil.centre_px, pupil.radius_px
    largest = largest or float(np.nanmax(np.abs(sheet))) or 1.0
    half = reach * radius * len(sheet) / (len(sheet) - 1)  # the outermost points are within the image
    extent = (x - half, x + half, y - half, y + half)
    image = axes.imshow(sheet, cmap=_SIGNED_COLOURS, vmin=-largest, vmax=largest, extent=extent)
    if len(layout) <= _MOST_OUTLINED:
        outlines: Any = list(lenslet_outlines(layout))
        axes.add_collection(
            PolyCollection(outlines, facecolors="none", edgecolors="#00000030", linewidths=0.6)
        )
    axes.add_patch(Circle((x, y), radius, fill=False, color="black", lw=0.8))
    margin = 1.12 * reach * radius
    axes.set(xlim=(x - margin, x + margin), ylim=(y - margin, y + margin), aspect="equal")
    axes.set(xlabel="column (px)", ylabel="row (px)")
    colour_bar(axes, image, unit)


def _bars(axes: Axes, wavefront: Wavefront, part: slice, several: bool) -> None:
    modes = wavefront.modes[part]
    if several:
        axes.bar(modes, wavefront.rms_of_frames[part], 0.85, color=FLUX_GREY, label="rms over the frames")
    axes.bar(
        modes,
        wavefront.mean[part],
        0.5,
        color=METHOD_COLOURS[1],
        yerr=np.nan_to_num(wavefront.mean_standard_error[part]),
        ecolor="black",
        capsize=2 if len(modes) < 50 else 0,
        label="mean over the frames ± standard error" if several else None,
    )
    axes.axhline(0, color="black", lw=0.8)
    axes.set_xlim(modes[0] - 0.7, modes[-1] + 0.7)
    step = -(-len(modes) // 45)
    labels = [f"{mode_name(int(j))}   Z{j} | {osa_index(int(j))}" for j in modes[::step]]
    axes.set_xticks(modes[::step], labels, rotation=90)
    axes.tick_params(axis="x", labelsize=9)
