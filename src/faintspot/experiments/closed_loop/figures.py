"""The figures of the closed-loop report: what is drawn, what it is in words, and its numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.methods import CONTROL_SIGN
from faintspot.experiments.closed_loop.results import MagnitudeResult, differences_by_flux
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.registry import estimators

_TEXT = Texts("faintspot.experiments")
_STREHL = "H-band Strehl ratio"
_MAGNITUDE = "guide-star magnitude"
_PHOTONS = "photo-electrons of a sub-aperture in a frame"
_DODGE = 0.008  # of the axis, between methods at the same magnitude
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))


def strehl_axis(wavelength_m: float) -> str:
    """Return the label of an axis of Strehl ratios."""
    return _STREHL if 1.5e-6 <= wavelength_m <= 1.8e-6 else f"Strehl ratio at {wavelength_m * 1e6:.3g} µm"


def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> FigureWithData:
    """Draw Strehl against magnitude for every method, and what each gains over the reference."""
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    strehls, differences, rows = [], [], []
    for method, name in enumerate(result.labels):
        value, error = means_of(result.strehl[method])
        style = {**method_style(result.names[method]), "capsize": 2}
        strehls.append(Line(name, result.magnitudes, value, error, style))
        found = differences_by_flux(result, method, reference)
        low, middle, high = np.array([[d.low, d.value, d.high] for d in found]).T
        if method != reference:
            shifted = result.magnitudes + (method - len(result.labels) / 2) * shift
            differences.append(Line("", shifted, middle, (middle - low, high - middle), style))
        count = np.full(len(value), result.strehl.shape[-1])
        columns = result.magnitudes, result.photons, value, error, count, low, middle, high
        rows += [[name, *row] for row in zip(*columns, strict=True)]
    above = result.magnitudes, result.photons.tolist(), _PHOTONS
    than = f"Strehl ratio minus that of {result.labels[reference]}, paired"
    left = Panel(strehls, _MAGNITUDE, label, y_range=(0, None), above=above)
    right = Panel(differences, _MAGNITUDE, than, levels={0.0: {}}, above=above)
    return _TEXT.figure("magnitude", plot([[left, right]], 6.4), rows)


def means_of(runs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of each row of runs, and its standard error, 0 where that is not known."""
    means = [paired_mean(values) for values in runs]
    return np.array([mean.value for mean in means]), np.nan_to_num([mean.standard_error for mean in means])


def method_style(name: str) -> dict[str, object]:
    """Return the style of a method's estimator; markers are hollow where the loop does more than the usual.

    Lines of control that learns are dash-dotted.
    """
    kinds = estimators()
    base = next((name[:end] for end in range(len(name), 0, -1) if name[:end] in kinds), "")
    style = kinds[base].style if base else Style("#666666")
    return {
        "color": style.colour,
        "marker": style.marker,
        "ms": 6,
        "mfc": style.colour if name == base else "white",
        "lw": 1.5,
        "ls": _LEARNING_LINE if CONTROL_SIGN in name else style.line,
    }
