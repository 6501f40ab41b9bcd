"""The figures of the closed-loop report: what is drawn, what it is in words, and its numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.ao_loop.telescope import PSF_SAMPLING
from faintspot.estimators.base import Style
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.registry import estimators
from faintspot.estimators.total_variation import TotalVariation
from faintspot.experiments.loop_analysis import (
    BEST_STRENGTHS,
    NO_TV,
    TV,
    TV_BEST,
    Measurements,
    differences_by_flux,
    differences_by_strength,
    paired_differences,
    regression_lines,
)
from faintspot.experiments.loop_methods import CONTROL_SIGN
from faintspot.experiments.loop_results import BudgetResult, MagnitudeResult
from faintspot.experiments.statistics import paired_mean
from faintspot.report.drawing import (
    FLUX_GREY,
    GREY,
    WIDTH,
    axis_above,
    colour_bar,
    new_figure,
    note,
    plain_ticks,
    styled,
)
from faintspot.report.figure_data import FigureWithData
from faintspot.report.texts import Texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_TEXT = Texts("faintspot.experiments")
_STREHL = "H-band Strehl ratio"
_DODGE = 0.008  # of the axis, between methods at the same magnitude
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))
_DECADES = 3  # of intensity in images

Floats = NDArray[np.float64]


def strehl_axis(wavelength_m: float) -> str:
    """Return the label of an axis of Strehl ratios."""
    return _STREHL if 1.5e-6 <= wavelength_m <= 1.8e-6 else f"Strehl ratio at {wavelength_m * 1e6:.3g} µm"


@styled
def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> FigureWithData:
    """Draw Strehl against magnitude for every method, and what each gains over the reference."""
    figure = new_figure(WIDTH, 6.4)
    left, right = figure.subplots(1, 2)
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    rows = []
    for method, name in enumerate(result.labels):
        runs = [paired_mean(values) for values in result.strehl[method]]
        value = np.array([run.value for run in runs])
        error = np.nan_to_num([run.standard_error for run in runs])
        place = result.magnitudes + (method - len(result.labels) / 2) * shift
        style = method_style(result.names[method])
        left.errorbar(result.magnitudes, value, error, label=name, capsize=2, **style)
        differences = differences_by_flux(result, method, reference)
        low, middle, high = np.array([[d.low, d.value, d.high] for d in differences]).T
        if method != reference:
            right.errorbar(place, middle, np.nan_to_num([middle - low, high - middle]), capsize=2, **style)
        count = np.full(len(value), result.strehl.shape[-1])
        columns = result.magnitudes, result.photons, value, error, count, low, middle, high
        rows += [[name, *row] for row in zip(*columns, strict=True)]
    right.axhline(0, color=GREY, lw=1)
    left.set(xlabel="guide-star magnitude", ylabel=label)
    left.set_ylim(bottom=0)
    right.set(xlabel="guide-star magnitude", ylabel=f"Strehl less that of {result.labels[reference]}, paired")
    for panel in (left, right):
        label_above = "photo-electrons of a sub-aperture in a frame"
        axis_above(panel, result.magnitudes, result.photons, label_above).tick_params(labelsize=10)
    figure.legend(loc="outside lower center", ncols=min(4, len(result.labels)), frameon=False)
    return _TEXT.figure("magnitude", figure, rows)


@styled
def gain_figure(result: MagnitudeResult) -> FigureWithData:
    """Draw the centroid gain of every method against the star's flux."""
    figure = new_figure(WIDTH * 0.7, 5.2)
    panel = figure.subplots()
    rows = []
    for method, name in enumerate(result.labels):
        value = np.array([paired_mean(values).value for values in result.centroid_gain[method]])
        panel.plot(result.photons, value, label=name, **method_style(result.names[method]))
        rows += [[name, p, v] for p, v in zip(result.photons, value, strict=True)]
    panel.axhline(1, color=GREY, lw=1)
    panel.set_xscale("log")
    plain_ticks(panel.xaxis, result.photons, ".3g")
    panel.set(xlabel="photo-electrons of a sub-aperture in a frame", ylabel="centroid gain")
    panel.set_ylim(bottom=0)
    figure.legend(loc="outside right upper", frameon=False)
    return _TEXT.figure("gain", figure, rows)


@styled
def psf_figure(images: Sequence[NDArray[Any]], names: Sequence[str], where: str) -> FigureWithData:
    """Draw long-exposure images on one logarithmic scale, and their profiles.

    Parameters
    ----------
    images : sequence of (p, p) arrays
        1 at the peak of a flat wavefront's; axis in the middle.
    names : sequence of str
    where : str
        What they were taken of.
    """
    from matplotlib.colors import LogNorm

    figure = new_figure(WIDTH, 4.6)
    panels = list(figure.subplots(1, len(images) + 1, width_ratios=[1] * len(images) + [1.15]))
    middle = len(images[0]) // 2
    half = middle / PSF_SAMPLING
    top = float(max(image.max() for image in images))
    scale = LogNorm(top * 10.0**-_DECADES, top)
    edge = half + 0.5 / PSF_SAMPLING
    shown = None
    profiles = []
    for panel, image, name in zip(panels, images, names, strict=False):
        values = np.maximum(image, top * 10.0**-_DECADES)
        shown = panel.imshow(values, norm=scale, extent=(-edge, edge, -edge, edge))
        panel.set(title=f"{name}: Strehl {image[middle, middle]:.3f}", xlabel="x (λ/D)", ylabel="y (λ/D)")
        profiles.append(_profile(image))
    colour_bar(panels[: len(images)], shown, "intensity (peak of a flat wavefront = 1)", "bottom")
    radius = np.arange(len(profiles[0])) / PSF_SAMPLING
    styles = BrightestPixels.style, TotalVariation.style
    for profile, name, style in zip(profiles, names, styles, strict=True):
        panels[-1].semilogy(radius, profile, style.line, color=style.colour, label=name)
    panels[-1].set(xlabel="distance from the axis (λ/D)", ylabel="mean intensity", title="Profiles")
    panels[-1].legend(frameon=False)
    rows = [[r, *p] for r, *p in zip(radius, *profiles, strict=True)]
    return _TEXT.figure("psf", figure, rows, ["radius_lambda_over_d", *names], where=where)


@styled
def budget_figure(result: BudgetResult, label: str) -> FigureWithData:
    """Draw the Strehl ratio of every method with each term of the error budget switched off."""
    terms, methods = len(result.terms), len(result.labels)
    figure = new_figure(WIDTH * 0.8, 1.6 + 0.2 * terms * (methods + 1))
    panel = figure.subplots()
    rows = []
    for method, name in enumerate(result.labels):
        runs = [paired_mean(values) for values in result.strehl[method]]
        value = np.array([run.value for run in runs])
        error = np.nan_to_num([run.standard_error for run in runs])
        place = np.arange(terms) + (method - (methods - 1) / 2) * 0.8 / methods
        colour = method_style(result.names[method])["color"]
        panel.barh(place, value, 0.72 / methods, xerr=error, color=colour, label=name, capsize=2, ecolor=GREY)
        panel.plot([value[0]] * 2, [-0.5, terms - 0.5], color=colour, lw=0.8, ls=":")
        rows += [[name, t, v, e] for t, v, e in zip(result.terms, value, error, strict=True)]
    panel.set_yticks(range(terms), [_switched(term) for term in result.terms])
    panel.invert_yaxis()
    panel.set(xlabel=label)
    figure.legend(loc="outside lower center", ncols=min(3, methods), frameon=False)
    return _TEXT.figure("budget", figure, rows)


def _switched(term: str) -> str:
    return "whole loop" if term == "nothing" else f"without {term}"


def method_style(name: str) -> dict[str, Any]:
    """Return the style of a method's estimator; markers are hollow where the loop does more than the usual.

    Lines of control that learns are dash-dotted.
    """
    known = estimators()
    base = next((name[:end] for end in range(len(name), 0, -1) if name[:end] in known), "")
    style = known[base].style if base else Style("#666666")
    return {
        "color": style.colour,
        "marker": style.marker,
        "ms": 6,
        "mfc": style.colour if name == base else "white",
        "lw": 1.5,
        "ls": _LEARNING_LINE if CONTROL_SIGN in name else style.line,
    }


def _profile(image: NDArray[Any]) -> Floats:
    """Return the mean intensity in rings of one pixel's width around the axis."""
    half = len(image) // 2
    row, column = np.indices(image.shape) - half
    ring = np.rint(np.hypot(row, column)).astype(int)
    sums = np.bincount(ring.ravel(), image.ravel().astype(np.float64))
    counts = np.bincount(ring.ravel())
    profile: Floats = (sums / counts)[: half + 1]
    return profile


# Okabe & Ito (2008) and a grey; the shape of the marker tells them apart as well.
_GROUP_STYLES = {NO_TV: ("#0072B2", "o"), TV: ("#767676", "^"), TV_BEST: ("#D55E00", "s")}
_GAP_S = 2.0  # between sets on the axis of time


def interleaved_figures(table: Measurements, wavelength_m: float) -> Iterator[FigureWithData]:
    """Yield the figures of interleaved observations."""
    yield strehl_figure(table, strehl_axis(wavelength_m))
    yield differences_figure(table)
    if np.isfinite(table.r0_m).any():
        yield seeing_figure(table)


@styled
def strehl_figure(table: Measurements, label: str) -> FigureWithData:
    """Draw the paper's three panels: Strehl against time, against r0 and against strength."""
    figure = new_figure(WIDTH, 9.4)
    panels = figure.subplot_mosaic([["time", "time"], ["r0", "strength"]])
    start = _starts(table)
    time = table.time_s + start[table.set_number]
    for name in (TV, TV_BEST, NO_TV):
        chosen = table.group(name) if name != TV else table.group(TV) & ~table.group(TV_BEST)
        style = _marker(name)
        panels["time"].plot(time[chosen], table.strehl[chosen], label=_legend_name(name), **style)
        panels["r0"].plot(100 * table.r0_m[chosen], table.strehl[chosen], **style)
        if name != NO_TV:
            panels["strength"].plot(table.strength_e[chosen], table.strehl[chosen], **style)
    _name_sets(panels["time"], table, start)
    panels["time"].set(xlabel="time, sets one after the other (s)", ylabel=label)
    panels["time"].set_ylim(top=1.13 * table.strehl.max())
    _draw_regression(panels["r0"], table)
    panels["r0"].set(xlabel="r0 at 500 nm from pseudo-open-loop slopes (cm)", ylabel=label)
    _draw_means(panels["strength"], table)
    panels["strength"].set(xlabel="strength of the denoising (e⁻)", ylabel=label)
    for panel in panels.values():
        panel.set_ylim(bottom=0)
    handles, names = panels["time"].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=3, frameon=False)
    return _TEXT.figure("strehl", figure, _measurement_rows(table))


@styled
def differences_figure(table: Measurements) -> FigureWithData:
    """Draw the paired differences from the neighbours without TV, by strength."""
    figure = new_figure(WIDTH * 0.7, 4.6)
    panel = figure.subplots()
    single, denoised = paired_differences(table), table.group(TV)
    panel.axhline(0, color=GREY, lw=1)
    panel.axvspan(*BEST_STRENGTHS, color=FLUX_GREY, lw=0, zorder=0)
    panel.plot(table.strength_e[denoised], single[denoised], **_marker(TV))
    found = differences_by_strength(table)
    rows = [[r.strength_e, r.difference.value, r.difference.low, r.difference.high, r.count] for r in found]
    strength, value, low, high, _ = np.array(rows, np.float64).reshape(-1, 5).T
    bars = np.nan_to_num([value - low, high - value])
    panel.errorbar(strength, value, bars, fmt="s-", color=_GROUP_STYLES[TV_BEST][0], lw=1.3, capsize=3)
    panel.set(xlabel="strength of the denoising (e⁻)", ylabel="Strehl with TV less Strehl without")
    low_end, high_end = panel.get_ylim()
    panel.set_ylim(max(low_end, -1.0), min(high_end, 1.0))
    return _TEXT.figure("differences", figure, rows)


@styled
def seeing_figure(table: Measurements) -> FigureWithData:
    """Draw r0 from the telemetry against the truth of the simulation."""
    figure = new_figure(WIDTH * 0.55, 5.6)
    panel = figure.subplots()
    known = np.isfinite(table.r0_m)
    top = 110 * float(max(np.percentile(table.r0_m[known], 98), table.true_r0_m.max()))
    ends = np.array([0.0, top])
    panel.fill_between(ends, 0.9 * ends, 1.1 * ends, color=FLUX_GREY, lw=0, label="within 10 %")
    panel.plot(ends, ends, color=GREY, lw=1)
    for name in (TV, TV_BEST, NO_TV):
        chosen = known & (table.group(name) if name != TV else table.group(TV) & ~table.group(TV_BEST))
        true, found = 100 * table.true_r0_m[chosen], 100 * table.r0_m[chosen]
        panel.plot(true, found, label=_legend_name(name), **_marker(name))
    panel.set(xlim=(0, top), ylim=(0, top), aspect="equal")
    panel.set(xlabel="true r0 at 500 nm (cm)", ylabel="r0 from pseudo-open-loop slopes (cm)")
    panel.legend(frameon=False, loc="upper left")
    return _TEXT.figure("seeing", figure, _measurement_rows(table))


def _marker(group: str) -> dict[str, Any]:
    colour, marker = _GROUP_STYLES[group]
    size = 4 if group == TV else 6
    return {"color": colour, "marker": marker, "ls": "", "ms": size, "mec": "white", "mew": 0.4}


def _legend_name(group: str) -> str:
    return "TV, other strengths" if group == TV else group


def _starts(table: Measurements) -> Floats:
    """Return where each set begins on the common axis of time, s."""
    sets = [table.time_s[table.set_number == number] for number in range(len(table.set_names))]
    lengths = [float(times.max(initial=0.0)) + _GAP_S for times in sets]
    return np.concatenate([[0.0], np.cumsum(lengths)[:-1]])


def _name_sets(panel: Axes, table: Measurements, start: Floats) -> None:
    ends = [*start[1:], None]
    for name, begin, end in zip(table.set_names, start, ends, strict=True):
        if end is not None:
            panel.axvline(end - _GAP_S / 2, color=GREY, lw=1)
        note(panel, name, (begin, 1.0), "data, axes fraction", xytext=(0, -14), fontsize=10)


def _draw_regression(panel: Axes, table: Measurements) -> None:
    shown = table.r0_m[np.isfinite(table.r0_m)]
    if not len(shown):
        return
    top = float(max(np.percentile(shown, 98), table.true_r0_m.max()))
    for name, line in regression_lines(table).items():
        chosen = table.group(name) & np.isfinite(table.r0_m) & (table.r0_m <= top)
        ends = np.array([table.r0_m[chosen].min(initial=top), table.r0_m[chosen].max(initial=0.0)])
        colour = _GROUP_STYLES[name][0]
        panel.plot(100 * ends, line(ends), color=colour, lw=2, label=f"{name}: r = {line.correlation:.2f}")
    panel.set_xlim(0, 105 * top)
    panel.legend(frameon=False, loc="upper left", fontsize=10)


def _draw_means(panel: Axes, table: Measurements) -> None:
    without = table.strehl[table.group(NO_TV)]
    if len(without):
        error = np.nan_to_num(paired_mean(without).standard_error)
        ends = without.mean() - error, without.mean() + error
        panel.axhspan(*ends, color=_GROUP_STYLES[NO_TV][0], alpha=0.2, lw=0)
        panel.axhline(without.mean(), color=_GROUP_STYLES[NO_TV][0], lw=1.3, label=NO_TV)
    rows = differences_by_strength(table)
    panel.plot([row.strength_e for row in rows], [row.strehl for row in rows], color="#000000", lw=1.3)


def _measurement_rows(table: Measurements) -> list[list[Any]]:
    columns = (table.time_s, table.strength_e, table.strehl, table.r0_m, table.true_r0_m, table.frames)
    names = [table.set_names[number] for number in table.set_number]
    return [[name, *row] for name, *row in zip(names, *(c.tolist() for c in columns), strict=True)]
