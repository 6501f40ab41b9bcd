"""The figures of the closed-loop report: what is drawn, what it is in words, and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.compare.statistics import paired_mean
from faintspot.estimators.base import Style
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.registry import estimators
from faintspot.estimators.total_variation import TotalVariation
from faintspot.loop.analysis import differences_by_flux
from faintspot.loop.arm_kinds import CONTROL_SIGN, VARIANTS
from faintspot.loop.results import BudgetResult, MagnitudeResult
from faintspot.loop.telescope import PSF_SAMPLING
from faintspot.report.drawing import GREY, WIDTH, colour_bar, new_figure, plain_ticks, styled
from faintspot.report.figure_data import FigureWithData

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STREHL = "H-band Strehl ratio"
_DODGE = 0.008  # of the axis, between arms at the same magnitude
_DECADES = 3  # of intensity in images

Floats = NDArray[np.float64]


def strehl_axis(wavelength_m: float) -> str:
    """Return the label of an axis of Strehl ratios."""
    return _STREHL if 1.5e-6 <= wavelength_m <= 1.8e-6 else f"Strehl ratio at {wavelength_m * 1e6:.3g} µm"


@styled
def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> FigureWithData:
    """Draw Strehl against magnitude for every arm, and what each gains over the reference."""
    figure = new_figure(WIDTH, 6.4)
    left, right = figure.subplots(1, 2)
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    rows = []
    for arm, name in enumerate(result.labels):
        runs = [paired_mean(values) for values in result.strehl[arm]]
        value = np.array([run.value for run in runs])
        error = np.nan_to_num([run.standard_error for run in runs])
        place = result.magnitudes + (arm - len(result.labels) / 2) * shift
        style = _arm_style(result.names[arm])
        left.errorbar(result.magnitudes, value, error, label=name, capsize=2, **style)
        differences = differences_by_flux(result, arm, reference)
        low, middle, high = np.array([[d.low, d.value, d.high] for d in differences]).T
        if arm != reference:
            right.errorbar(place, middle, np.nan_to_num([middle - low, high - middle]), capsize=2, **style)
        rows += [
            [name, m, p, v, e, len(s), *ends]
            for m, p, v, e, s, *ends in zip(
                result.magnitudes,
                result.photons,
                value,
                error,
                result.strehl[arm],
                low,
                middle,
                high,
                strict=True,
            )
        ]
    right.axhline(0, color=GREY, lw=1)
    left.set(xlabel="guide-star magnitude", ylabel=label)
    left.set_ylim(bottom=0)
    right.set(
        xlabel="guide-star magnitude",
        ylabel=f"Strehl less that of {result.labels[reference]}, paired",
    )
    for panel in (left, right):
        _photon_axis(panel, result)
    figure.legend(loc="outside lower center", ncols=min(4, len(result.labels)), frameon=False)
    caption = (
        "Every arm tuned at every flux on other air. Left, bars: standard error between realisations of the "
        "air. Right: the same realisations compared; bars hold for all fluxes of an arm together with 95 %; "
        "points are moved sideways to be told apart."
    )
    header = ["arm", "magnitude", "photons", "strehl", "standard_error", "realisations"]
    header += ["difference_low", "difference", "difference_high"]
    return FigureWithData("magnitude", "Strehl against magnitude", caption, figure, header, rows)


@styled
def gain_figure(result: MagnitudeResult) -> FigureWithData:
    """Draw the centroid gain of every arm against the star's light."""
    figure = new_figure(WIDTH * 0.7, 5.2)
    panel = figure.subplots()
    rows = []
    for arm, name in enumerate(result.labels):
        value = np.array([paired_mean(values).value for values in result.centroid_gain[arm]])
        panel.plot(result.photons, value, label=name, **_arm_style(result.names[arm]))
        rows += [[name, p, v] for p, v in zip(result.photons, value, strict=True)]
    panel.axhline(1, color=GREY, lw=1)
    panel.set_xscale("log")
    plain_ticks(panel.xaxis, result.photons, ".3g")
    panel.set(xlabel="photo-electrons of a sub-aperture in a frame", ylabel="centroid gain")
    panel.set_ylim(bottom=0)
    figure.legend(loc="outside right upper", frameon=False)
    caption = "Slope measured for a displacement of 1 px, at the flux of the run, with spots as in the loop."
    header = ["arm", "photons", "centroid_gain"]
    return FigureWithData("gain", "Centroid gain", caption, figure, header, rows)


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
    caption = f"{where}; the same logarithmic scale in both. Strehl ratio: intensity on the axis."
    rows = [[r, *p] for r, *p in zip(radius, *profiles, strict=True)]
    return FigureWithData(
        "psf", "Long-exposure image", caption, figure, ["radius_lambda_over_d", *names], rows
    )


@styled
def budget_figure(result: BudgetResult, label: str) -> FigureWithData:
    """Draw the Strehl ratio of every arm with each term of the error budget switched off."""
    terms, arms = len(result.terms), len(result.labels)
    figure = new_figure(WIDTH * 0.8, 1.6 + 0.2 * terms * (arms + 1))
    panel = figure.subplots()
    rows = []
    for arm, name in enumerate(result.labels):
        runs = [paired_mean(values) for values in result.strehl[arm]]
        value = np.array([run.value for run in runs])
        error = np.nan_to_num([run.standard_error for run in runs])
        place = np.arange(terms) + (arm - (arms - 1) / 2) * 0.8 / arms
        colour = _arm_style(result.names[arm])["color"]
        panel.barh(place, value, 0.72 / arms, xerr=error, color=colour, label=name, capsize=2, ecolor=GREY)
        panel.plot([value[0]] * 2, [-0.5, terms - 0.5], color=colour, lw=0.8, ls=":")
        rows += [[name, t, v, e] for t, v, e in zip(result.terms, value, error, strict=True)]
    panel.set_yticks(range(terms), [_switched(term) for term in result.terms])
    panel.invert_yaxis()
    panel.set(xlabel=label)
    figure.legend(loc="outside lower center", ncols=min(3, arms), frameon=False)
    caption = (
        "One term of the error budget switched off at a time. Bars: standard error between realisations; "
        "dotted: the whole loop."
    )
    header = ["arm", "switched_off", "strehl", "standard_error"]
    return FigureWithData("budget", "Error budget", caption, figure, header, rows)


def _switched(term: str) -> str:
    return "whole loop" if term == "nothing" else f"without {term}"


def _arm_style(name: str) -> dict[str, Any]:
    """Return the style of an arm's estimator; markers are hollow where the loop does more than the usual."""
    known = estimators()
    base = next((name[:end] for end in range(len(name), 0, -1) if name[:end] in known), "")
    style = known[base].style if base else Style("#666666")
    variants = [ending for ending in (*VARIANTS, CONTROL_SIGN) if ending in name[len(base) :]]
    return {
        "color": style.colour,
        "marker": style.marker,
        "ms": 6 + len(variants),
        "mfc": "white" if variants else style.colour,
        "lw": 1.3,
        "ls": ":" if len(variants) > 1 else style.line,
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


def _photon_axis(panel: Axes, result: MagnitudeResult) -> None:
    """Write the photo-electrons along the top."""
    top = panel.secondary_xaxis("top")
    top.set_xticks(result.magnitudes, [f"{photons:.3g}" for photons in result.photons])
    top.set_xlabel("photo-electrons of a sub-aperture in a frame")
    top.tick_params(labelsize=10)
