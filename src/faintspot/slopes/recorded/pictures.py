"""Figures of recorded slopes: a frame after every step, followed spots, and maps over all frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.report import plots
from faintspot.base.report.page import FigureWithData
from faintspot.base.report.texts import Texts, plain_number
from faintspot.slopes.estimators.base import Step
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slopes import Slopes, Stages
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.sensor.drawing import Arrows, Map, asinh_stretch, map_height
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.sodium import SodiumProfile

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TEXT = Texts("faintspot.slopes.recorded")
_MOST_MARKED = 150  # sub-apertures of the whole sensor's picture: of more, marks would hide the spots
_MARKS = (("+", "white"), ("x", "#D55E00"), ("1", "#E69F00"), ("2", "#CC79A7"))  # with a black outline
_ON_DARK = {"facecolor": "#333333", "labelcolor": "white", "edgecolor": "none", "frameon": True}
_ABOVE: dict[str, Any] = {"legend": "outside upper center", **_ON_DARK}
_PATH, _VALID, _INVALID = "#56B4E9", "#E69F00", "#CC79A7"
_MOST_FRAMES = 200  # of which the paths of followed spots are drawn
_ARROWS_WHOLE_PERCENT = 98  # of the slopes, whose arrows are never cut
_MOST_SHORT_ARROWS = 400  # of more sub-apertures, arrows within their own could not be seen


@dataclass(frozen=True)
class Example:
    """One frame after every step.

    Attributes
    ----------
    layout : Layout
    stages : mapping of Stages
        By method; images (n_subapertures, ny, nx). The first one's images are shown, the positions of all are
        marked. They must be measured from the sub-apertures' centres (no other reference).
    number : int
        Number of the frame in the recording.
    truth : array (n_subapertures, 2), optional
        True x, y, px.
    steps : sequence of Step
        What is shown of them; "raw" first.
    unit : str
        Unit of the calibrated images.
    """

    layout: Layout
    stages: Mapping[str, Stages]
    number: int = 0
    truth: Floats | None = None
    steps: Sequence[Step] = TotalVariation.steps_shown
    unit: str = "e-"

    @property
    def first(self) -> Stages:
        """Stages whose images are shown."""
        return next(iter(self.stages.values()))

    @property
    def shown_steps(self) -> dict[str, str]:
        """Attributes of `Stages` by title; raw images only where they are not calibrated already."""
        same = np.allclose(self.first.raw, self.first.calibrated, rtol=1e-5, equal_nan=True)
        return {title: step for title, step in self.steps if step != "raw" or not same}

    def positions(self) -> dict[str, Floats]:
        """Return valid positions by method, and the truth, from the window's middle, px; NaN if invalid."""
        positions = {}
        for name, stages in self.stages.items():
            xy = np.stack([stages.slopes.x, stages.slopes.y], axis=-1).astype(np.float64)
            positions[name] = np.where(stages.slopes.valid[:, None], xy, np.nan) + self.layout.offsets
        if self.truth is not None:
            positions["truth"] = self.truth + self.layout.offsets
        return positions


def sensor_figure(example: Example) -> FigureWithData:
    """Draw all windows of the calibrated frame at their places, with the positions of the spots."""
    layout, images = example.layout, example.first.calibrated
    sheet, start = assembled(layout, images), layout.corners.min(axis=0) - 0.5
    # Gaps of a pixel between windows, where the pitch is not a whole number, are no lines.
    known = np.pad(np.isfinite(sheet), 1, mode="edge")
    closed = scipy.ndimage.binary_closing(known, np.ones((3, 3)))[1:-1, 1:-1]
    sheet[closed & np.isnan(sheet)] = np.nanmedian(images)
    (low, high), (n_rows, n_columns) = plots.limits_of(images, percent=99.8), sheet.shape
    extent = start[1], start[1] + n_columns, start[0], start[0] + n_rows
    middles = layout.corners[:, ::-1] + 0.5 * (np.array(layout.window[::-1]) - 1)
    few = len(layout) <= _MOST_MARKED
    marks = _crosses({name: xy + middles for name, xy in example.positions().items()}, 6) if few else []
    style = {"vmin": low, "vmax": high, "extent": extent}
    picture = plots.Picture(sheet, f"{example.unit} per pixel", style=style, marks=marks)
    width = 0.62 * plots.WIDTH
    values = {
        "frame": example.number,
        "marked": few,
        "circles": "" if example.truth is None else ", circles true ones",
    }
    height = min(max(0.84 * width * n_rows / n_columns, 1.2), 9.0) + 0.7
    return _TEXT.figure("sensor", [[picture]], height, values, width=width, **_ABOVE)


def steps_figure(example: Example) -> FigureWithData:
    """Draw the faintest, a median and the brightest valid sub-aperture after every step."""
    stages, steps, chosen = example.first, example.shown_steps, example_subapertures(example.first)
    height, width = example.layout.window
    style: dict[str, Any] = {"extent": (-width / 2, width / 2, -height / 2, height / 2)}
    positions, rows = example.positions(), list[list[plots.Picture]]()
    for which, index in chosen.items():
        limits = plots.limits_of(stages.calibrated[index], percent=99.8)
        crosses = _crosses({name: xy[index : index + 1] for name, xy in positions.items()}, 13)
        y = f"{which}\nno. {index}, {plain_number(float(stages.slopes.flux[index]))} {example.unit}\ny (px)"
        row = list[plots.Picture]()
        for title, step in steps.items():
            image, is_raw = getattr(stages, step)[index], step == "raw"
            low, high = plots.limits_of(image, percent=99.8) if is_raw else limits
            unit = "ADU" if is_raw else f"{example.unit} per pixel" if title == list(steps)[-1] else ""
            options = {**style, "vmin": low, "vmax": high}
            above, marks = "" if rows else title, [] if is_raw else crosses
            row.append(plots.Picture(image, unit, above, "x (px)", "" if row else y, options, marks))
        rows.append(row)
    panel = plots.WIDTH / 5.3
    size = len(rows) * (panel * min(height / width, 2.0) + 0.4) + 0.9
    values, options = {"shown": next(iter(example.stages))}, {"width": panel * (len(steps) + 1.3), **_ABOVE}
    return _TEXT.figure("subapertures", rows, size, values, shared=True, **options)


def example_subapertures(stages: Stages) -> dict[str, int]:
    """Return the numbers of the faintest, a median and the brightest valid sub-aperture, each once.

    Without any valid one it is the sub-aperture with the most flux after calibration.
    """
    valid = np.flatnonzero(stages.slopes.valid)
    if valid.size == 0:
        return {"none is valid": int(np.argmax(stages.calibrated.sum(axis=(-2, -1))))}
    order = valid[np.argsort(stages.slopes.flux[valid], kind="stable")]
    places = {"faintest": 0, "median": len(order) // 2, "brightest": len(order) - 1}
    names = {1: ["brightest"], 2: ["faintest", "brightest"]}.get(len(order), list(places))
    return {name: int(order[places[name]]) for name in names}


def assembled(layout: Layout, images: NDArray[np.generic]) -> Floats:
    """Return the windows' images (n, ny, nx) at their places; NaN between them."""
    start = layout.corners.min(axis=0)
    height, width = layout.corners.max(axis=0) - start + np.array(layout.window)
    sheet = np.full((height, width), np.nan)
    rows, columns = layout.window_pixels
    sheet[rows - start[0], columns - start[1]] = images
    return sheet


def _crosses(positions: Mapping[str, Floats], size: float) -> list[plots.Line]:
    """Return marks: crosses for each method, the first one's on top, and circles for the truth."""
    from matplotlib.patheffects import withStroke

    width = 0.5 + 0.08 * size
    around = [withStroke(linewidth=2.6 * width, foreground="black")]
    circle = {"marker": "o", "ms": 1.5 * size, "mfc": "none", "mec": plots.TRUTH_COLOUR}
    crosses = iter(_MARKS)
    lines = []
    for order, (name, xy) in enumerate(positions.items()):
        style = circle
        if name != "truth":
            marker, colour = next(crosses)
            style = {
                "marker": marker,
                "ms": size,
                "color": colour,
                "path_effects": around,
                "zorder": 3 - 0.1 * order,
            }
        lines.append(plots.Line.of(name, xy, {"ls": "", "mew": width, **style}))
    return lines


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
    layout : Layout
    """

    frame: NDArray[Any]
    number: int
    slopes: Slopes
    reference: Floats
    layout: Layout

    @property
    def largest_pitches(self) -> float:
        """Largest displacement of a valid spot, in pitches."""
        length = np.hypot(self.slopes.x, self.slopes.y)[self.slopes.valid]
        return float(length.max(initial=0.0) / (self.layout.pitch_px or np.nan))


def farthest_frame(slopes: Slopes) -> int:
    """Return the number of the frame in which the valid spots are displaced most, as rms."""
    squares = np.where(slopes.valid, slopes.x**2 + slopes.y**2, 0.0)
    return int(np.argmax(squares.sum(axis=1) / np.maximum(slopes.valid.sum(axis=1), 1)))


def followed_figure(followed: Followed) -> FigureWithData:
    """Draw a frame with an arrow from each reference position to its spot, and the paths of all spots."""
    slopes, number, layout = followed.slopes, followed.number, followed.layout
    nodes = layout.centres + followed.reference
    at = nodes + np.stack([slopes.x, slopes.y], axis=-1)
    shown = np.where(slopes.valid[..., None], at, np.nan)
    paths = shown[:: -(-len(shown) // _MOST_FRAMES)].transpose(1, 0, 2)
    path, cross = (
        {"color": _PATH, "lw": 0.7},
        {"ls": "", "marker": "+", "ms": 4, "mew": 0.8, "color": "white"},
    )
    valid, doubtful = slopes.valid[number], slopes.measured[number] & ~slopes.valid[number]
    arrows = {"color": _VALID, "label": "valid spot", "scale": 1.0, "width": 0.004, "zorder": 3}
    circle = {"ls": "", "marker": "o", "mfc": "none", "color": _INVALID}
    marks: list[plots.Mark] = [
        *(plots.Line.of("path over all frames", xy, path) for xy in paths),
        plots.Line.of("reference", nodes, cross),
        Arrows(nodes[valid], (at[number] - nodes)[valid], arrows),
        *([plots.Line.of("crossing or doubtful", at[number][doubtful], circle)] if doubtful.any() else []),
    ]
    everything = np.concatenate([nodes, shown.reshape(-1, 2)])
    frame, margin = np.asarray(followed.frame, np.float64), 0.7 * max(layout.window)
    left, low = np.maximum(np.nanmin(everything, axis=0) - margin, -0.5)
    right, high = np.minimum(np.nanmax(everything, axis=0) + margin, np.array(frame.shape[::-1]) - 0.5)
    style = {"cmap": "gray", "norm": asinh_stretch(frame, layout.images(frame))}
    limits: dict[str, Any] = {"x_range": (left, right), "y_range": (low, high)}
    picture = plots.Picture(frame, "frame's units", style=style, marks=marks, **limits)
    height = min(0.9 * plots.WIDTH * (high - low) / (right - left) + 0.5, 1.3 * plots.WIDTH)
    return _TEXT.figure("followed-frame", [[picture]], height, {"frame": number}, **_ABOVE)


def maps_figure(
    methods: Sequence[MeasuredSlopes], jitters: Sequence[Floats], layout: Layout, unit: str = "e-"
) -> FigureWithData:
    """Draw flux, valid frames and jitter, a row of maps for each method; of one frame, flux only."""
    several = methods[0].n_frames > 1
    flux_limits = plots.limits_of(*(method.flux_e for method in methods), low=0.0)
    jitter_limits = plots.limits_of(*jitters, low=0.0)
    rows = []
    for method, jitter_px in zip(methods, jitters, strict=True):
        name = f"{method.name}: {'median ' if several else ''}flux"
        row = [Map(layout, method.flux_e, f"flux ({unit})", name, flux_limits)]
        if several:
            percent = 100.0 * method.valid_frames / method.n_frames
            row.append(Map(layout, percent, "valid frames (%)", "valid frames", (0, 100)))
            row.append(Map(layout, jitter_px, "jitter (px)", "jitter", jitter_limits))
        rows.append(row)
    width = plots.WIDTH if several else 0.6 * plots.WIDTH
    height = len(rows) * map_height(layout, len(rows[0]))
    return _TEXT.figure("flux", rows, height, {"several": several}, width=width)


def arrows_figure(methods: Sequence[MeasuredSlopes], layout: Layout) -> FigureWithData:
    """Draw the mean slope of every sub-aperture, one panel per method, all at one scale.

    Those longer than `longest_arrow` are cut to that length and drawn black.
    """
    longest, number = longest_arrow(methods)
    maps, several = arrow_maps(methods, layout, longest), methods[0].n_frames > 1
    values = {
        "longest": longest,
        "percent": _ARROWS_WHOLE_PERCENT,
        "number": number or None,
        "several": several,
    }
    figure_width = plots.WIDTH if len(maps) > 1 else 0.6 * plots.WIDTH
    return _TEXT.figure("slopes", [maps], map_height(layout, len(maps)), values, width=figure_width)


def plot_slopes(slopes: Slopes, layout: Layout | None, axes: Axes | None) -> Axes:
    """Draw what `Slopes.plot` returns."""
    if layout is None:
        raise InputError(
            "layout: unknown to slopes that no pipeline has measured; state it: plot(layout=...)"
        )
    if len(layout) != slopes.x.shape[-1]:
        raise InputError(f"layout: expected {slopes.x.shape[-1]} sub-apertures, got {len(layout)}")
    variables = {name: np.atleast_2d(values) for name, values in slopes.variables.items()}
    method = MeasuredSlopes("", Slopes.from_variables(variables, keep=slopes.keep))
    (arrows,) = arrow_maps([method], layout, longest_arrow([method])[0])
    return plots.draw([[arrows]], axes)  # type: ignore[no-any-return]


def arrow_maps(methods: Sequence[MeasuredSlopes], layout: Layout, longest: float) -> list[Map]:
    """Return maps of mean slopes; arrows longer than `longest` px are cut and black."""
    pitch, several = layout.pitch_px or max(layout.window), methods[0].n_frames > 1
    length, width = (0.6, 0.004) if len(layout) <= _MOST_SHORT_ARROWS else (2.0, 0.0015)
    maps = []
    for method, colour in zip(methods, plots.METHOD_COLOURS, strict=False):
        known, long = method.valid_frames > 0, np.hypot(*method.mean_px.T)
        shown = (method.mean_px * np.minimum(1.0, longest / np.maximum(long, longest))[:, None])[known]
        colours = np.where(long > longest, "black", colour)[known]
        style = {"color": colours, "scale": longest / (length * pitch), "width": width}
        cross = {"ls": "", "marker": "x", "color": plots.GREY, "ms": 5}
        arrows = Arrows(layout.centres[known], shown, style, _round_length(longest))
        title = f"{method.name and f'{method.name}: '}{'mean slope' if several else 'slope'}"
        maps.append(
            Map(layout, title=title, marks=[arrows, plots.Line.of("", layout.centres[~known], cross)])
        )
    return maps


def longest_arrow(methods: Sequence[MeasuredSlopes]) -> tuple[float, int]:
    """Return the length, px, at which arrows are cut, and how many are longer.

    It is a percentile, so that a few wild slopes do not make all others too short to be seen; lengths within
    half of it more are left as they are.
    """
    lengths = np.concatenate([np.hypot(*method.mean_px[method.valid_frames > 0].T) for method in methods])
    usual = float(np.percentile(lengths, _ARROWS_WHOLE_PERCENT)) if lengths.size else 0.0
    if usual <= 0:
        return float(lengths.max(initial=0.0)) or 1.0, 0
    longest = min(float(lengths.max()), 1.5 * usual)
    return longest, int(np.count_nonzero(lengths > longest))


def _round_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))


def profile_figure(profiles: Mapping[str, SodiumProfile]) -> FigureWithData:
    """Draw the density of profiles against altitude; the last one is emphasised."""
    *_, newest = profiles
    lines = []
    for index, (name, profile) in enumerate(profiles.items()):
        style: dict[str, object] = {"color": plots.METHOD_COLOURS[1], "lw": 2.2}
        if name != newest:
            style = {"color": plots.GREY, "lw": 1.6, "ls": ("--", ":", "-.")[index % 3]}
        label = f"{name}\n(mean {profile.mean_m / 1e3:.1f} km, std {profile.std_m / 1e3:.1f} km)"
        lines.append(plots.Line(label, 1e3 * profile.density, profile.altitudes_m / 1e3, style=style))
    flux, height = "return flux per km of altitude", "altitude above sea level (km)"
    panel = plots.Panel(lines, flux, height, x_range=(0, None), legend=True)
    return _TEXT.figure("sodium", [[panel]], 4.6, width=0.6 * plots.WIDTH, legend="")
