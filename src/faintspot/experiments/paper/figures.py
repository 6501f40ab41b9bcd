"""Figures of a study: the slope error against the signal by sweep, comparison of methods, figure 1."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.report.page import FigureWithData
from faintspot.base.report.plots import METHOD_COLOURS, WIDTH, Line, Panel, Picture
from faintspot.base.report.texts import Texts
from faintspot.experiments.methods import NO_TV, TV, knows_the_spot, label_of, style_of
from faintspot.experiments.paper.claims import fixed_mode, grouped, in_words, mode_in_words, parameters_of
from faintspot.experiments.study.curves import kept_panels, measured_profiles, names_of, shared_in_words
from faintspot.experiments.study.specification import BEST
from faintspot.experiments.study.sweep import PARAMETERS, STANDARD
from faintspot.slopes.estimators.noise import suggested_strength, tv_denoise
from faintspot.slopes.recorded.pictures import assembled
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, spots

if TYPE_CHECKING:
    import xarray


_TEXT = Texts("faintspot.experiments")
_ROW_HEIGHT = 4.7
_FEW_LINES = 5  # in a panel; with more it is made higher
_LARGEST_RATIO = 1.6  # of R to R without denoising; what is above is cut off
_MARKERS = "osD^vPX<>*"
_ERROR_TICKS = (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 3)
_KEPT_TICKS = (1, 3, 10, 30, 100)
_TV_OR_NOT: dict[str, dict[str, object]] = {TV: {"ls": "-"}, NO_TV: {"ls": "--", "mfc": "white"}}
_LEGEND: dict[str, dict[str, Any]] = {
    "TV": {"color": "#333333", "ls": "-"},
    "no TV": {"color": "#333333", "ls": "--", "marker": "o", "mfc": "white"},
}
ERROR_AXIS = "slope error R (px)"
MAIN_NOISES_E = (0.1, 3.0, 16.0)


def axis_of_study(axis: str) -> dict[str, Any]:
    """Return label and ticks of the axis of a parameter, as of `Panel`; the flux's is logarithmic."""
    ticks = (10, 30, 100, 300, 1000, 3000, 10000) if axis == "flux_e" else ()
    return {"x": _TEXT[f"axes.{axis}"], "x_ticks": ticks, "grid": True}


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
    varied = [key for key in PARAMETERS if len({row[key] for row in table}) > 1]
    labelled = [key for key in varied if key not in (axis, "profile", "position_range_px")]
    styles = _styles([in_words(labelled, values) for values in grouped(dataset, cells, labelled, axis)])
    scale = axis_of_study(axis) | {"x_range": _range_of(axis, [float(row[axis]) for row in table])}
    panels: list[list[Panel]] = []
    for (profile, reach), kept in grouped(dataset, cells, ("profile", "position_range_px"), axis).items():
        parts = grouped(dataset, kept, labelled, axis)
        named = {in_words(labelled, values): part for values, part in parts.items()}
        scale |= {"y": ERROR_AXIS, "y_ticks": _ERROR_TICKS, "levels": {reach / 2: {"ls": ":"}}}
        panels.append([])
        for mode in _modes(dataset):
            heading = f"{mode_in_words(mode)}: {profile} spots, positions within ±{reach:g} px"
            lines = _tv_lines(dataset.sel(mode=mode), named, styles, axis)
            panels[-1].append(Panel(lines, title=heading, **scale))
    common = {key: table[0][key] for key in PARAMETERS if key not in (*varied, axis)}
    fixed, shown = in_words(list(common), list(common.values())), shared_in_words(common)
    handles = {**_LEGEND, **{label: style for label, style in styles.items() if label}}
    height = _ROW_HEIGHT if len(styles) <= _FEW_LINES else 1.3 * _ROW_HEIGHT
    return FigureWithData.of(
        name,
        title,
        _TEXT("sweep.caption", fixed=fixed or "nothing"),
        panels,
        height * len(panels) + 0.8,
        heading=f"{title}  ({shown})" if shown else title,
        columns=5,
        handles=[Line(label, [], [], style=style) for label, style in handles.items()],
        shared=True,
    )


def kept_pixels_figure(dataset: xarray.Dataset) -> FigureWithData | None:
    """Draw R against the number of brightest pixels kept (the paper's figure 5); None without cells."""
    every = (kept_panels(dataset, profile) for profile in measured_profiles(dataset))
    rows_of_panels = [parts for parts in every if parts]
    if not rows_of_panels or not {NO_TV, TV} <= {*names_of(dataset, "estimator")}:
        return None
    panels: list[list[Panel]] = []
    fixed = fixed_mode(dataset).removeprefix("fixed")
    scale: dict[str, Any] = {"x": "brightest pixels kept, k", "x_ticks": _KEPT_TICKS, "y": ERROR_AXIS}
    scale |= {"y_ticks": _ERROR_TICKS[2:], "at": {float(fixed): {"ls": ":"}}, "legend": True}
    for parts in rows_of_panels:
        panels.append([])
        for part in parts:
            styles = _styles([label for label, _ in part.cells])
            lines = [
                line
                for label, cell in part.cells
                for line in _over_k(dataset, cell, label, styles[label]["color"])
            ]
            head, _, tail = part.title.partition(";" if part.title.startswith("signals") else ", ")
            panels[-1].append(
                Panel(lines, title=f"{head.strip()}\n{tail.strip().replace(';', ',')}", **scale)
            )
    heading = f"{_TEXT['fig5.title']}  (solid: TV, dashed: no TV)"
    options: dict[str, Any] = {"width": WIDTH * 1.25, "legend": ""}
    height = _ROW_HEIGHT * len(panels) * 1.1
    return _TEXT.figure("fig5", panels, height, {"fixed": fixed}, heading=heading, **options)


def baselines_figure(dataset: xarray.Dataset, profile: str) -> FigureWithData | None:
    """Draw R of every method over R without denoising, for the main read noises; None without cells."""
    cells = _main_cells(dataset, profile)
    methods = [method for method in names_of(dataset, "estimator") if not knows_the_spot(method)]
    if not cells or NO_TV not in methods or len(methods) < 2:
        return None
    panels: list[list[Panel]] = []
    for noise, indices in cells.items():
        panels.append([])
        for mode in _modes(dataset):
            lines = []
            for method in methods:
                style = style_of(method)
                bars = {"color": style.colour, "ls": style.line, "marker": style.marker, "ms": 5, "lw": 2}
                ratio = _ratio(dataset, indices, method, mode)
                lines.append(Line(label_of(method), *ratio, {**bars, "elinewidth": 1}))
            lowest = min([0.6, *(0.95 * np.min(line.y) for line in lines)])
            title = f"{mode_in_words(mode)}: {noise:g} e- read noise"
            scale = axis_of_study("flux_e") | {
                "x_range": _range_of("flux_e", dataset["flux_e"].values[indices])
            }
            limits: dict[str, Any] = {"y": "R / R without denoising", "y_range": (lowest, _LARGEST_RATIO)}
            panels[-1].append(Panel(lines, title=title, **scale, **limits))
    reach = float(dataset["position_range_px"].values[next(iter(cells.values()))[0]])
    title = _TEXT("baselines_figure.title", profile=profile)
    above = f"{title}  (size 1, 16 × 16 px, positions within ±{reach:g} px)"
    caption = _TEXT("baselines_figure.caption", largest=_LARGEST_RATIO)
    height = _ROW_HEIGHT * len(cells) + 0.8
    return FigureWithData.of(f"baselines-{profile}", title, caption, panels, height, heading=above, columns=3)


def _axis_of(table: list[dict[str, object]]) -> str:
    counts = {
        name: len({row[name] for row in table}) for name in ("flux_e", *PARAMETERS) if name != "profile"
    }
    return "flux_e" if counts["flux_e"] > 1 else max(counts, key=lambda name: counts[name])


def _modes(dataset: xarray.Dataset) -> list[str]:
    return [mode for mode in (BEST, fixed_mode(dataset)) if mode in names_of(dataset, "mode")]


def _styles(labels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of each label: told apart with any colour vision, in order when many."""
    from matplotlib import colormaps

    colours: Sequence[object] = METHOD_COLOURS
    if len(labels) > len(METHOD_COLOURS):
        colours = [colormaps["viridis"](fraction) for fraction in np.linspace(0.0, 0.9, len(labels))]
    return {
        label: {"color": colours[i], "marker": _MARKERS[i % len(_MARKERS)]}
        for i, label in enumerate(dict.fromkeys(labels))
    }


def _tv_lines(
    dataset: xarray.Dataset, parts: dict[str, list[int]], styles: dict[str, dict[str, object]], axis: str
) -> list[Line]:
    """Return R with and without TV against an axis, for each label."""
    lines = []
    for label, cells in parts.items():
        for method, line in _TV_OR_NOT.items():
            if method in dataset["estimator"].values:
                part = dataset[["error", "error_se"]].sel(estimator=method).isel(cell=cells)
                style = {**styles[label], "ms": 5, "elinewidth": 1, "lw": 1.9, **line}
                x, y, error = (part[name].values for name in (axis, "error", "error_se"))
                name = f"{label_of(method)} {label}".strip()
                lines.append(Line(name, x, y, error, style, in_legend=False))
    return lines


def _range_of(axis: str, values: ArrayLike) -> tuple[float | None, float | None]:
    """Return the limits of an axis: a single value, as of an unfinished study, gives none."""
    low, high = float(np.min(values)), float(np.max(values))
    if axis == "flux_e":
        return low / 1.25, high * 1.25
    margin = 0.05 * (high - low)
    return (low - margin, high + margin) if margin else (None, None)


def _over_k(dataset: xarray.Dataset, cell: int, label: str, colour: object) -> Iterator[Line]:
    """Yield R of a cell against the number of pixels kept; circles are those chosen."""
    k = dataset["k"].values
    for method in (TV, NO_TV):
        part = dataset.sel(estimator=method).isel(cell=cell)
        y, error = part["error_at_k"].values, part["error_at_k_se"].values
        style = {"color": colour, "lw": 1.9, "ls": _TV_OR_NOT[method]["ls"]}
        name = label if method == TV else f"{label}, no TV"
        yield Line(name, k, y, error, style, band=True, in_legend=method == TV)
        chosen = k == float(part["chosen_k"].sel(mode=BEST))
        circle = {"color": colour, "ls": "", "marker": "o", "mfc": "white", "ms": 7, "mew": 1.6}
        yield Line(f"{name}, chosen", k[chosen], y[chosen], style=circle, in_legend=False)


def _main_cells(dataset: xarray.Dataset, profile: str) -> dict[float, list[int]]:
    """Return the cells of round Nyquist-sampled spots in 16 px, by read noise and flux."""
    varied = ("flux_e", "read_noise_e", "position_range_px")
    standard = {name: value for name, value in STANDARD.items() if name not in varied} | {"profile": profile}
    kept = dataset["done"].values & np.all(
        [dataset[name] == value for name, value in standard.items()], axis=0
    )
    if not kept.any():
        return {}
    reach = dataset["position_range_px"].values
    kept &= (reach == reach[kept].min()) & np.isin(dataset["read_noise_e"], MAIN_NOISES_E)
    cells = grouped(dataset, np.flatnonzero(kept).tolist(), ("read_noise_e",), "flux_e")
    return {noise: part for (noise,), part in cells.items()}


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


def triple_picture() -> FigureWithData:
    """Draw the sensor in three states, and one of its spots below each."""
    layout, images = triple_images()
    style = {"vmin": 0.0, "vmax": float(np.percentile(images[1], 99.9))}
    units = "", "", "signal (e- per pixel)"
    shown = {"sensor": [assembled(layout, stack) for stack in images]}
    shown["one spot"] = [stack[len(layout) // 2] for stack in images]
    rows = [
        [
            Picture(image, unit, f"{what}, {name}", style=style)
            for image, unit, name in zip(stack, units, _NAMES, strict=True)
        ]
        for what, stack in shown.items()
    ]
    values = {"flux": FLUX_E, "noise": READ_NOISE_E, "reach": POSITION_RANGE_PX}
    return _TEXT.figure("fig1", rows, 9.4, values)
