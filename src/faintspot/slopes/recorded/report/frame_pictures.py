"""Pictures of a frame: the sensor, sub-apertures after every step, and spots that left their windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.plots import (
    FLUX_GREY,
    TRUTH_COLOUR,
    WIDTH,
    colour_bar,
    limits_of,
    new_figure,
    styled,
)
from faintspot.slopes.estimators.base import Step
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slopes import Slopes, Stages
from faintspot.slopes.recorded.layout_picture import asinh_stretch
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

MOST_MARKED = 150
"""With more sub-apertures than this the whole sensor's picture has no marks: they would hide the spots."""
_MOST_PIXELS = 400  # a side of the whole sensor's picture: of more, spots would be too small to be seen
_MARKS = (("+", "white"), ("x", "#D55E00"), ("1", "#E69F00"), ("2", "#CC79A7"))  # with a black outline

_PATH, _VALID, _INVALID = "#56B4E9", "#E69F00", "#CC79A7"
_MOST_FRAMES = 200  # of which the paths of followed spots are drawn


@dataclass(frozen=True)
class Example:
    """One frame after every step.

    Attributes
    ----------
    layout : Layout
    stages : mapping of Stages
        By method; images (n_subapertures, ny, nx). The first one's images are shown, the positions of all are
        marked. They must be measured from the sub-apertures' centres (no other reference).
    truth : array (n_subapertures, 2), optional
        True x, y, px.
    steps : sequence of Step
        What is shown of them; "raw" first.
    """

    layout: Layout
    stages: Mapping[str, Stages]
    truth: Floats | None = None
    steps: Sequence[Step] = TotalVariation.steps_shown

    @property
    def first(self) -> Stages:
        """Stages whose images are shown."""
        return next(iter(self.stages.values()))

    @property
    def raw_is_calibrated(self) -> bool:
        """Whether the raw frame is in electrons already."""
        return bool(np.allclose(self.first.raw, self.first.calibrated, rtol=1e-5, equal_nan=True))

    @property
    def shown_steps(self) -> dict[str, str]:
        """Attributes of `Stages` by title; a raw frame in electrons is not shown twice and nothing else."""
        only_twice = len(self.steps) == 2 and self.raw_is_calibrated
        return dict(self.steps[:1] if only_twice else self.steps)

    def positions(self) -> dict[str, Floats]:
        """Return valid positions by method, and the truth, from the window's middle, px; NaN if invalid."""
        positions = {}
        for name, stages in self.stages.items():
            xy = np.stack([stages.slopes.x, stages.slopes.y], axis=-1).astype(np.float64)
            positions[name] = np.where(stages.slopes.valid[:, None], xy, np.nan) + self.layout.offsets
        if self.truth is not None:
            positions["truth"] = self.truth + self.layout.offsets
        return positions


@styled
def whole_sensor(example: Example) -> Figure:
    """Draw all windows of the calibrated frame at their places, with the positions of the spots."""
    layout, images = example.layout, example.first.calibrated
    factor = coarseness(layout)
    sheet = coarser(assembled(layout, images), factor)
    start, (n_rows, n_columns) = layout.corners.min(axis=0) - 0.5, factor * np.array(sheet.shape)
    width = 0.62 * WIDTH
    figure = new_figure(width, min(max(0.84 * width * n_rows / n_columns, 1.2), 9.0) + 0.7)
    axes = figure.subplots()
    low, high = limits_of(images, percent=99.8)
    extent = (start[1], start[1] + n_columns, start[0], start[0] + n_rows)
    image = axes.imshow(sheet, vmin=low, vmax=high, extent=extent, interpolation="nearest")
    axes.set(xlabel="column (px)", ylabel="row (px)", facecolor=FLUX_GREY)
    colour_bar(axes, image, "e- per pixel")
    if len(layout) <= MOST_MARKED:
        middles = layout.corners[:, ::-1] + 0.5 * (np.array(layout.window[::-1]) - 1)
        _mark(axes, {name: xy + middles for name, xy in example.positions().items()}, size=6)
        _legend(figure, axes)
    return figure


def coarseness(layout: Layout) -> int:
    """Return how many frame pixels a side make one of the whole sensor's picture, so that it can be seen."""
    height, width = np.ptp(layout.corners, axis=0) + np.array(layout.window)
    return max(1, -(-int(max(height, width)) // _MOST_PIXELS))


def coarser(sheet: Floats, factor: int) -> Floats:
    """Return the largest of each `factor` x `factor` pixels, so that spots stay visible; NaN is left out."""
    if factor == 1:
        return sheet
    rows, columns = (-(-length // factor) * factor for length in sheet.shape)
    padded = np.full((rows, columns), -np.inf)
    padded[: sheet.shape[0], : sheet.shape[1]] = np.where(np.isfinite(sheet), sheet, -np.inf)
    largest = padded.reshape(rows // factor, factor, columns // factor, factor).max(axis=(1, 3))
    return np.where(np.isfinite(largest), largest, np.nan)


@styled
def zoom(example: Example) -> Figure:
    """Draw the faintest, a median and the brightest valid sub-aperture after every step."""
    chosen, steps = example_subapertures(example.first), example.shown_steps
    height, width = example.layout.window
    panel_width = WIDTH / 5.3
    figure = new_figure(
        panel_width * (len(steps) + 1.3), len(chosen) * (panel_width * min(height / width, 2.0) + 0.25) + 0.9
    )
    grid = figure.subplots(len(chosen), len(steps), squeeze=False, sharex=True, sharey=True)
    extent = (-width / 2, width / 2, -height / 2, height / 2)
    positions = example.positions()
    for row, (which, index) in enumerate(chosen.items()):
        axes = list(grid[row])
        images = {title: getattr(example.first, step)[index] for title, step in steps.items()}
        shown = _draw_steps(axes, images, example.raw_is_calibrated, extent, titles=row == 0)
        if not example.raw_is_calibrated:
            colour_bar(axes[0], shown["raw"], "ADU")
        electrons = axes if example.raw_is_calibrated else axes[1:]
        colour_bar(electrons, list(shown.values())[-1], "e- per pixel")
        axes[0].set_ylabel(f"{which}\nno. {index}, {_flux(example.first, index)} e-\ny (px)")
        for panel in axes[1:] or axes:
            _mark(panel, {name: xy[index : index + 1] for name, xy in positions.items()}, size=13)
    for panel in grid[-1]:
        panel.set_xlabel("x (px)")
    _legend(figure, grid[0, -1])
    return figure


def _flux(stages: Stages, index: int) -> str:
    flux = float(stages.slopes.flux[index])
    return f"{flux:.0f}" if abs(flux) >= 100 else f"{flux:.3g}"


def example_subapertures(stages: Stages) -> dict[str, int]:
    """Return the numbers of the faintest, a median and the brightest valid sub-aperture, each once.

    Without any valid one it is the sub-aperture with the most flux after calibration.
    """
    valid = np.flatnonzero(stages.slopes.valid)
    if valid.size == 0:
        flux = stages.calibrated.sum(axis=(-2, -1))
        return {"none is valid": int(np.argmax(flux))}
    order = valid[np.argsort(stages.slopes.flux[valid], kind="stable")]
    chosen = {"brightest": int(order[-1])}
    if len(order) > 1:
        chosen = {"faintest": int(order[0]), **chosen}
    if len(order) > 2:
        chosen = {"faintest": int(order[0]), "median": int(order[len(order) // 2]), **chosen}
    return chosen


def assembled(layout: Layout, images: NDArray[np.generic]) -> Floats:
    """Return the windows' images (n, ny, nx) at their places; NaN between them."""
    start = layout.corners.min(axis=0)
    height, width = layout.corners.max(axis=0) - start + np.array(layout.window)
    sheet = np.full((height, width), np.nan)
    rows, columns = layout.window_pixels
    sheet[rows - start[0], columns - start[1]] = images
    return sheet


def _draw_steps(
    axes: list[Axes], images: Mapping[str, Floats], one_unit: bool, extent: Any, titles: bool = True
) -> dict[str, Any]:
    """Draw the steps on one colour scale, raw on its own one when it is in ADU; return the images."""
    adu = limits_of(images["raw"], percent=99.8)
    electrons = adu if one_unit else limits_of(images["calibrated"], percent=99.8)
    shown = {}
    for panel, (step, image) in zip(axes, images.items(), strict=True):
        low, high = adu if step == "raw" else electrons
        shown[step] = panel.imshow(image, vmin=low, vmax=high, extent=extent, interpolation="nearest")
        panel.set_facecolor(FLUX_GREY)
        if titles:
            panel.set_title(step + (" (ADU)" if step == "raw" and not one_unit else ""))
    return shown


def _mark(axes: Axes, positions: Mapping[str, Floats], size: float) -> None:
    """Mark positions: each method by its own cross, the first one's on top, and the truth by a circle."""
    from matplotlib.patheffects import withStroke

    width = 0.5 + 0.08 * size
    outline = withStroke(linewidth=2.6 * width, foreground="black")
    crosses = dict(zip((name for name in positions if name != "truth"), _MARKS, strict=False))
    for name, xy in positions.items():
        if name == "truth":
            axes.plot(*xy.T, "o", ms=1.5 * size, mfc="none", mec=TRUTH_COLOUR, mew=width, ls="", label=name)
        elif name in crosses:
            marker, colour = crosses[name]
            order = 3.0 - 0.1 * list(crosses).index(name)
            axes.plot(*xy.T, marker, ms=size, mew=width, color=colour, ls="", label=name, zorder=order)
            axes.lines[-1].set_path_effects([outline])


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles,
            labels,
            loc="outside upper center",
            ncols=len(labels),
            facecolor="#777777",
            labelcolor="white",
            edgecolor="none",
        )


@dataclass(frozen=True)
class Followed:
    """Spots of a recording that were followed, and the frame of the picture.

    Attributes
    ----------
    frame : array (h, w)
    number : int
        Its number in the recording.
    slopes : Slopes
        Slopes of all frames [px].
    reference : array (n_subapertures, 2)
        Reference positions, px from the sub-apertures' centres.
    """

    frame: NDArray[Any]
    number: int
    slopes: Slopes
    reference: NDArray[np.float64]

    def largest_pitches(self, layout: Layout) -> float:
        """Return the largest displacement of a valid spot, in pitches."""
        length = np.hypot(self.slopes.x, self.slopes.y)[self.slopes.valid]
        return float(length.max(initial=0.0) / (layout.pitch_px or np.nan))


def farthest_frame(slopes: Slopes) -> int:
    """Return the number of the frame in which the valid spots are displaced most, as rms."""
    squares = np.where(slopes.valid, slopes.x**2 + slopes.y**2, 0.0)
    return int(np.argmax(squares.sum(axis=1) / np.maximum(slopes.valid.sum(axis=1), 1)))


@styled
def followed_picture(followed: Followed, layout: Layout) -> Figure:
    """Draw a frame with an arrow from each reference position to its spot, and the paths of all spots."""
    from matplotlib.collections import LineCollection

    slopes, number = followed.slopes, followed.number
    nodes = layout.centres + followed.reference
    at = nodes + np.stack([slopes.x, slopes.y], axis=-1)
    shown = np.where(slopes.valid[..., None], at, np.nan)
    everything = np.concatenate([nodes, shown.reshape(-1, 2)])
    margin = 0.7 * max(layout.window)
    (left, top), (right, bottom) = (
        np.nanmin(everything, axis=0) - margin,
        np.nanmax(everything, axis=0) + margin,
    )
    figure = new_figure(WIDTH, min(0.9 * WIDTH * (bottom - top) / (right - left) + 0.5, 1.3 * WIDTH))
    axes = figure.subplots()
    frame = np.asarray(followed.frame, np.float64)
    image = axes.imshow(frame, cmap="gray", norm=asinh_stretch(frame, layout.images(frame)))
    colour_bar(axes, image, "frame's units")
    paths = shown[:: -(-len(shown) // _MOST_FRAMES)].transpose(1, 0, 2)
    axes.add_collection(LineCollection(list(paths), colors=_PATH, linewidths=0.7))
    axes.plot(*nodes.T, "+", ms=4, mew=0.8, color="white", label="reference")
    valid, doubtful = slopes.valid[number], slopes.measured[number] & ~slopes.valid[number]
    options: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004, "zorder": 3}
    axes.quiver(*nodes[valid].T, *(at[number] - nodes)[valid].T, color=_VALID, label="valid spot", **options)
    if doubtful.any():
        axes.plot(*at[number][doubtful].T, "o", mfc="none", color=_INVALID, label="crossing or doubtful")
    axes.plot([], [], color=_PATH, label="path over all frames")
    height, width = frame.shape
    axes.set(
        xlim=(max(left, -0.5), min(right, width - 0.5)), ylim=(max(top, -0.5), min(bottom, height - 0.5))
    )
    axes.set(xlabel="column (px)", ylabel="row (px)")
    _legend(figure, axes)
    return figure
