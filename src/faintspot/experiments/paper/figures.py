"""Figures of a study: the slope error against the signal by sweep, comparison of methods, figure 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.drawing import (
    GREY,
    METHOD_COLOURS,
    WIDTH,
    colour_bar,
    new_figure,
    plain_ticks,
    styled,
)
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.texts import Texts
from faintspot.experiments.methods import NO_TV, TV, knows_the_spot, label_of, style_of
from faintspot.experiments.paper.claims import fixed_mode
from faintspot.experiments.paper.tables import (
    mode_in_words,
    parameter_in_words,
    parameters_of,
    table_of_cells,
)
from faintspot.experiments.study.curves import kept_panels
from faintspot.experiments.study.specification import BEST
from faintspot.experiments.study.sweep import PARAMETERS
from faintspot.slopes.estimators.algorithms.noise import suggested_strength
from faintspot.slopes.estimators.algorithms.total_variation import tv_denoise
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, spots

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_TEXT = Texts("faintspot.experiments")
_ROW_HEIGHT = 4.7
_FEW_LINES = 5  # in a panel; with more it is made higher
_LARGEST_RATIO = 1.6  # of R to R without denoising; what is above is cut off
_MARKERS = "osD^vPX<>*"
ERROR_AXIS = "slope error R (px)"
MAIN_NOISES_E = (0.1, 3.0, 16.0)


@dataclass(frozen=True)
class _Line:
    label: str
    x: np.ndarray
    cells: np.ndarray


@styled
def sweep_figure(dataset: xarray.Dataset, cells: Sequence[int], name: str, title: str) -> FigureWithData:
    """Draw R of the cells of a sweep with TV (solid) and without (dashed), in both modes side by side.

    One row for each spot profile and range of positions. The axis is the flux, or what has most values in a
    sweep of one flux.

    Parameters
    ----------
    dataset : xarray.Dataset
    cells : sequence of int
        Finished cells, at least one.
    name, title : str
    """
    table = parameters_of(dataset, cells)
    axis = _axis_of(table)
    rows = sorted({(row["profile"], row["position_range_px"]) for row in table})
    varied = [key for key in PARAMETERS if len({row[key] for row in table}) > 1]
    labelled = [key for key in varied if key not in (axis, "profile", "position_range_px")]
    modes = _modes(dataset)
    everything = _lines(table, cells, axis, labelled)
    height = _ROW_HEIGHT if len(everything) <= _FEW_LINES else 1.3 * _ROW_HEIGHT
    figure = new_figure(WIDTH, height * len(rows) + 0.8)
    axes = figure.subplots(len(rows), len(modes), squeeze=False, sharex=True, sharey="row")
    styles = _styles([line.label for line in everything])
    for panels, (profile, reach) in zip(axes, rows, strict=True):
        part = [row["profile"] == profile and row["position_range_px"] == reach for row in table]
        kept = [index for index, belongs in enumerate(part) if belongs]
        lines = _lines([table[i] for i in kept], [cells[i] for i in kept], axis, labelled)
        for panel, mode in zip(panels, modes, strict=True):
            _limit(panel, axis, [row[axis] for row in table])
            _draw_lines(panel, dataset, lines, mode, styles)
            panel.set_title(f"{mode_in_words(mode)}: {profile} spots, positions within ±{reach:g} px")
            panel.axhline(reach / 2, color=GREY, lw=1, ls=":")
            label_axes(panel, axis)
        panels[0].set_ylabel(ERROR_AXIS)
    _legend(figure, styles)
    fixed = [parameter_in_words(key, table[0][key]) for key in PARAMETERS if key not in (*varied, axis)]
    named = [words for words in fixed if not words.startswith("no ")]
    figure.suptitle(f"{title}  ({', '.join(named)})" if named else title, fontsize=14)
    caption = _TEXT("sweep.caption", fixed=", ".join(fixed) or "nothing")
    return FigureWithData(name, title, caption, figure, *table_of_cells(dataset, cells))


@styled
def kept_pixels_figure(dataset: xarray.Dataset) -> FigureWithData | None:
    """Draw R against the number of brightest pixels kept (the paper's figure 5); None without cells."""
    profiles = sorted({str(p) for p in dataset["profile"].values[dataset["done"].values]})
    panels = [(profile, kept_panels(dataset, profile)) for profile in profiles]
    panels = [(profile, parts) for profile, parts in panels if parts]
    if not panels or not {NO_TV, TV} <= set(dataset["estimator"].values):
        return None
    figure = new_figure(WIDTH * 1.25, _ROW_HEIGHT * len(panels) * 1.1)
    axes = figure.subplots(len(panels), 3, squeeze=False)
    rows: list[list[Any]] = []
    fixed = fixed_mode(dataset).removeprefix("fixed")
    for line, (_, parts) in zip(axes, panels, strict=True):
        for panel, part in zip(line, parts, strict=True):
            styles = _styles([label for label, _ in part.cells])
            for label, cell in part.cells:
                rows += _draw_over_k(panel, dataset, cell, label, styles[label][0])
            panel.axvline(float(fixed), color=GREY, lw=1, ls=":")
            panel.set_xscale("log")
            panel.set_yscale("log")
            plain_ticks(panel.xaxis, (1, 3, 10, 30, 100))
            plain_ticks(panel.yaxis, (0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 3))
            head, _, tail = part.title.partition(";" if part.title.startswith("signals") else ", ")
            panel.set_title(f"{head.strip()}\n{tail.strip().replace(';', ',')}", fontsize=12)
            panel.set_xlabel("brightest pixels kept, k")
            panel.legend(frameon=False, fontsize=10, handlelength=1.2)
        line[0].set_ylabel(ERROR_AXIS)
    figure.suptitle(f"{_TEXT['fig5.title']}  (solid: TV, dashed: no TV)", fontsize=14)
    header = ["panel", "method", "k", "R_px", "R_se_px", *PARAMETERS]
    return _TEXT.figure("fig5", figure, rows, header, fixed=fixed)


@styled
def baselines_figure(dataset: xarray.Dataset, profile: str) -> FigureWithData | None:
    """Draw R of every method over R without denoising, for the main read noises; None without cells."""
    cells = _main_cells(dataset, profile)
    methods = [str(method) for method in dataset["estimator"].values if not knows_the_spot(str(method))]
    if not cells or NO_TV not in methods or len(methods) < 2:
        return None
    modes = _modes(dataset)
    figure = new_figure(WIDTH, _ROW_HEIGHT * len(cells) + 0.8)
    axes = figure.subplots(len(cells), len(modes), squeeze=False, sharey="row")
    reach = float(dataset["position_range_px"].values[next(iter(cells.values()))[0]])
    for panels, (noise, indices) in zip(axes, cells.items(), strict=True):
        lowest = 0.6
        for panel, mode in zip(panels, modes, strict=True):
            _limit(panel, "flux_e", dataset["flux_e"].values[indices])
            for method in methods:
                flux, ratio, se = _ratio(dataset, indices, method, mode)
                lowest = min([lowest, *(0.95 * ratio)])
                style = style_of(method)
                bars = {"color": style.colour, "marker": style.marker, "ms": 5, "lw": 2, "elinewidth": 1}
                panel.errorbar(flux, ratio, se, label=label_of(method), ls=style.line, **bars)
            panel.set_title(f"{mode_in_words(mode)}: {noise:g} e- read noise")
            label_axes(panel, "flux_e", log_y=False)
        panels[0].set_ylim(lowest, _LARGEST_RATIO)
        panels[0].set_ylabel("R / R without denoising")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    title = _TEXT("baselines_figure.title", profile=profile)
    figure.suptitle(f"{title}  (size 1, 16 × 16 px, positions within ±{reach:g} px)", fontsize=14)
    caption = _TEXT("baselines_figure.caption", largest=_LARGEST_RATIO)
    every = [cell for part in cells.values() for cell in part]
    return FigureWithData(f"baselines-{profile}", title, caption, figure, *table_of_cells(dataset, every))


def _axis_of(table: list[dict[str, Any]]) -> str:
    counts = {name: len({row[name] for row in table}) for name in PARAMETERS if name != "profile"}
    if counts["flux_e"] > 1:
        return "flux_e"
    return max(counts, key=lambda name: counts[name]) if max(counts.values()) > 1 else "flux_e"


def _modes(dataset: xarray.Dataset) -> list[str]:
    measured = [str(mode) for mode in dataset["mode"].values]
    return [mode for mode in (BEST, fixed_mode(dataset)) if mode in measured]


def _lines(
    table: list[dict[str, Any]], cells: Sequence[int], axis: str, labelled: Sequence[str]
) -> list[_Line]:
    """Return the lines of a panel, by increasing value of what varies."""
    groups: dict[tuple[Any, ...], list[tuple[float, int]]] = {}
    for row, cell in zip(table, cells, strict=True):
        groups.setdefault(tuple(row[key] for key in labelled), []).append((float(row[axis]), cell))
    lines = []
    for values, points in sorted(groups.items()):
        label = ", ".join(parameter_in_words(key, value) for key, value in zip(labelled, values, strict=True))
        x, index = zip(*sorted(points), strict=True)
        lines.append(_Line(label, np.array(x), np.array(index)))
    return lines


def _styles(labels: Sequence[str]) -> dict[str, tuple[Any, str]]:
    """Return colour and marker of each label: told apart with any colour vision, in order when many."""
    from matplotlib import colormaps

    if len(labels) <= 4:
        colours: list[Any] = list(METHOD_COLOURS)
    else:
        colours = [colormaps["viridis"](fraction) for fraction in np.linspace(0.0, 0.9, len(labels))]
    return {label: (colours[i], _MARKERS[i % len(_MARKERS)]) for i, label in enumerate(dict.fromkeys(labels))}


def _draw_lines(
    panel: Axes, dataset: xarray.Dataset, lines: Sequence[_Line], mode: str, styles: dict[str, Any]
) -> None:
    for line in lines:
        colour, marker = styles[line.label]
        for method, style, face in ((TV, "-", colour), (NO_TV, "--", "white")):
            if method not in dataset["estimator"].values:
                continue
            part = dataset[["error", "error_se"]].sel(estimator=method, mode=mode).isel(cell=line.cells)
            y, se = part["error"].values, part["error_se"].values
            finite = np.isfinite(y)
            bars = {"color": colour, "marker": marker, "ms": 5, "mfc": face, "elinewidth": 1, "capsize": 0}
            panel.errorbar(line.x[finite], y[finite], se[finite], ls=style, lw=1.9, **bars)


def _limit(panel: Axes, axis: str, values: Any) -> None:
    """Set the horizontal limits beforehand: of a single value, as of an unfinished study, there are none."""
    low, high = float(np.min(values)), float(np.max(values))
    if axis == "flux_e":
        panel.set_xlim(low / 1.25, high * 1.25)
    else:
        margin = 0.05 * (high - low)
        panel.set_xlim(low - margin, high + margin)


def label_axes(panel: Axes, axis: str, *, log_y: bool = True) -> None:
    """Label the axis of a parameter; the flux's is logarithmic."""
    if axis == "flux_e":
        panel.set_xscale("log")
        plain_ticks(panel.xaxis, (10, 30, 100, 300, 1000, 3000, 10000))
    if log_y:
        panel.set_yscale("log")
        plain_ticks(panel.yaxis, (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 3))
    panel.set_xlabel(_TEXT[f"axes.{axis}"])
    panel.tick_params(labelbottom=True)
    panel.grid(which="major", color="#e4e4e4", lw=0.7)


def _legend(figure: Figure, styles: dict[str, tuple[Any, str]]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color="#333333", lw=2, label="TV"),
        Line2D([], [], color="#333333", lw=2, ls="--", marker="o", mfc="white", label="no TV"),
    ]
    handles += [
        Line2D([], [], color=colour, marker=marker, lw=2, label=label)
        for label, (colour, marker) in styles.items()
        if label
    ]
    columns = min(len(handles), 5)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def _draw_over_k(panel: Axes, dataset: xarray.Dataset, cell: int, label: str, colour: Any) -> list[list[Any]]:
    rows = []
    k = dataset["k"].values
    parameters = parameters_of(dataset, [cell])[0]
    for method, style in ((TV, "-"), (NO_TV, "--")):
        part = dataset.sel(estimator=method).isel(cell=cell)
        y, se = part["error_at_k"].values, part["error_at_k_se"].values
        ok = np.isfinite(y)
        panel.plot(k[ok], y[ok], ls=style, color=colour, lw=1.9, label=label if method == TV else None)
        panel.fill_between(k[ok], (y - se)[ok], (y + se)[ok], color=colour, alpha=0.25, lw=0)
        chosen = float(part["chosen_k"].sel(mode=BEST))
        if np.isfinite(chosen):
            error = y[k == int(chosen)]
            panel.plot([chosen] * len(error), error, "o", color=colour, mfc="white", ms=7, mew=1.6)
        rows += [
            [label, method, int(number), f"{value:.6g}", f"{error:.3g}", *parameters.values()]
            for number, value, error in zip(k[ok], y[ok], se[ok], strict=True)
        ]
    return rows


def _main_cells(dataset: xarray.Dataset, profile: str) -> dict[float, list[int]]:
    """Return the cells of round Nyquist-sampled spots in 16 px, by read noise and flux."""
    done = np.flatnonzero(dataset["done"].values)
    standard = {"profile": profile, "size": 1.0, "elongation": 1.0, "pixels": 16}
    standard |= {"background_e": 0.0, "em_gain": 1.0, "d_over_r0": 0.0}
    table = zip(done, parameters_of(dataset, done.tolist()), strict=True)
    kept = [(int(i), row) for i, row in table if all(row[name] == value for name, value in standard.items())]
    if not kept:
        return {}
    reach = min(row["position_range_px"] for _, row in kept)
    cells: dict[float, list[int]] = {}
    for i, row in sorted(kept, key=lambda item: item[1]["flux_e"]):
        if row["read_noise_e"] in MAIN_NOISES_E and row["position_range_px"] == reach:
            cells.setdefault(row["read_noise_e"], []).append(i)
    return dict(sorted(cells.items()))


def _ratio(
    dataset: xarray.Dataset, cells: Sequence[int], method: str, mode: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flux, R over R without denoising, and its paired standard error, by the delta method."""
    part = dataset.isel(cell=list(cells)).sel(mode=mode)
    error, plain = part["error"].sel(estimator=method).values, part["error"].sel(estimator=NO_TV).values
    covariance = part["error_covariance"]
    of_method, of_plain, of_both = (
        covariance.sel(estimator=a, estimator2=b).values
        for a, b in ((method, method), (NO_TV, NO_TV), (method, NO_TV))
    )
    ratio = error / plain
    variance = (of_method + ratio**2 * of_plain - 2 * ratio * of_both) / plain**2
    finite = np.isfinite(ratio)
    return part["flux_e"].values[finite], ratio[finite], np.sqrt(np.maximum(variance, 0))[finite]


FLUX_E = 200.0
READ_NOISE_E = 3.0
POSITION_RANGE_PX = 1.0
_SEED = 1503
_NAMES = ("without noise", "with photon and read noise", "after TV")


def triple_images() -> tuple[Layout, list[NDArray[np.float64]]]:
    """Return a 7 x 7 sensor and its sub-aperture images without noise, with noise and denoised, e-."""
    layout = Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    rng = np.random.default_rng(_SEED)
    positions = rng.uniform(-POSITION_RANGE_PX, POSITION_RANGE_PX, (len(layout), 2))
    clean = spots(positions, shape=layout.window, flux_e=FLUX_E)
    noisy = Detector(read_noise_e=READ_NOISE_E).expose(clean, rng).astype(np.float64)
    denoised = tv_denoise(noisy, suggested_strength(READ_NOISE_E, FLUX_E, layout.pixels))
    return layout, [clean, noisy, denoised]


@styled
def triple_picture() -> FigureWithData:
    """Draw the sensor in three states, and one of its spots below each."""
    layout, images = triple_images()
    shown = len(layout) // 2
    figure = new_figure(WIDTH, 9.4)
    axes = figure.subplots(2, 3)
    brightest = float(np.percentile(images[1], 99.9))
    for column, (name, stack) in enumerate(zip(_NAMES, images, strict=True)):
        frame = np.full(layout.frame_shape, np.nan)
        for (row, left), image in zip(layout.corners, stack, strict=True):
            frame[row : row + layout.window[0], left : left + layout.window[1]] = image
        sensor_image = _show(axes[0, column], frame, brightest, f"sensor, {name}")
        spot_image = _show(axes[1, column], stack[shown], brightest, f"one spot, {name}")
    colour_bar(list(axes[0]), sensor_image, "signal (e- per pixel)")
    colour_bar(list(axes[1]), spot_image, "signal (e- per pixel)")
    rows = [
        [y, x, *(f"{stack[shown, y, x]:.6g}" for stack in images)]
        for y in range(layout.window[0])
        for x in range(layout.window[1])
    ]
    values = {"flux": FLUX_E, "noise": READ_NOISE_E, "reach": POSITION_RANGE_PX}
    return _TEXT.figure("fig1", figure, rows, **values)


def _show(panel: Axes, image: NDArray[np.float64], brightest: float, title: str) -> object:
    shown = panel.imshow(image, vmin=0.0, vmax=brightest, interpolation="nearest")
    panel.set_title(title, fontsize=12)
    panel.set_xlabel("column (px)")
    panel.set_ylabel("row (px)")
    return shown
