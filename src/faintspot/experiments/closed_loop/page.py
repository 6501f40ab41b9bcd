"""The report page of a closed-loop experiment: one HTML text that needs nothing else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, FigureWithData, Report, Section, configuration_section
from faintspot.base.report.plots import Line, Panel
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.results import MagnitudeResult, differences_by_flux
from faintspot.experiments.closed_loop.verdict import (
    loop_verdict,
    reference_methods,
    settings_table,
    strehl_table,
)
from faintspot.loop.control.base import split_control
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.registry import estimators

_TEXT = Texts("faintspot.experiments")
_FEW_REALISATIONS = 5
_DODGE = 0.008  # of the axis, between methods at the same magnitude
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))


def loop_page(result: MagnitudeResult) -> Report:
    """Return the report page of closed-loop results."""
    configuration = _configuration(result.configuration)
    wavelength_um = 1.65 if configuration is None else configuration.science.wavelength_m * 1e6
    name = "" if configuration is None else f": “{configuration.name}”"
    sections = [
        _TEXT.section("verdict", *loop_verdict(result)),
        *_of_magnitudes(result, f"Strehl ratio at {wavelength_um:.3g} µm"),
        configuration_section(result.configuration),
    ]
    facts = {} if configuration is None else _facts(configuration)
    return Report(f"Closed loop{name}", facts, sections, loop_warnings(result), remark=POSITIONS)


def loop_warnings(result: MagnitudeResult) -> list[str]:
    """Return what a reader should know before the results: what is unfinished or too little."""
    missing, count = int(np.isnan(result.strehl).sum()), result.strehl.shape[-1]
    return _TEXT.lines(
        "loop.warnings",
        missing=missing or None,
        runs=result.strehl.size,
        few=count if count < _FEW_REALISATIONS else None,
        fewest=_FEW_REALISATIONS,
    )


def _of_magnitudes(result: MagnitudeResult, strehl: str) -> list[Section]:
    """Return the sections of Strehl against magnitude; `strehl` is the label of an axis."""
    references = reference_methods(result)
    figure = magnitude_figure(result, references[0], strehl)
    base = " and then with ".join(result.labels[method] for method in references)
    return [
        _TEXT.section("magnitude", strehl_table(result), figure, shape=result.strehl.shape, reference=base),
        _TEXT.section("settings", settings_table(result)),
    ]


def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> FigureWithData:
    """Draw Strehl against magnitude for every method, and its difference from the reference."""
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    strehls, differences = [], []
    for method, name in enumerate(result.labels):
        style = {**_style(result.names[method]), "capsize": 2}
        strehls.append(Line(name, result.magnitudes, *_means_of(result.strehl[method]), style))
        if method != reference:
            found = differences_by_flux(result, method, reference)
            low, middle, high = np.array([[d.low, d.value, d.high] for d in found]).T
            shifted = result.magnitudes + (method - len(result.labels) / 2) * shift
            differences.append(Line(name, shifted, middle, (middle - low, high - middle), style))
    above = result.magnitudes, result.photons.tolist(), "photo-electrons of a sub-aperture in a frame"
    than, magnitude = f"Strehl ratio minus that of {result.labels[reference]}, paired", "guide-star magnitude"
    left = Panel(strehls, magnitude, label, y_range=(0, None), above=above)
    right = Panel(differences, magnitude, than, levels={0.0: {}}, above=above)
    return _TEXT.figure("magnitude", [[left, right]], 6.4)


def _means_of(runs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of each row of runs, and its standard error, NaN where that is not known."""
    means = [paired_mean(values) for values in runs]
    return np.array([mean.value for mean in means]), np.array([mean.standard_error for mean in means])


def _style(name: str) -> dict[str, object]:
    """Return the style of a method's estimator; markers are hollow where the loop does more than the usual.

    Lines of control that learns are dash-dotted.
    """
    kinds = estimators()
    base = next((name[:end] for end in range(len(name), 0, -1) if name[:end] in kinds), "")
    style = kinds[base].style if base else Style("#666666")
    filling = style.colour if name == base else "white"
    line = _LEARNING_LINE if split_control(name)[1] else style.line
    return {"color": style.colour, "marker": style.marker, "ms": 6, "mfc": filling, "lw": 1.5, "ls": line}


def _configuration(text: str) -> LoopConfiguration | None:
    """Return the configuration of a TOML text, or None when it is not known."""
    try:
        return LoopConfiguration.from_text(text) if text else None
    except InputError:
        return None


def _facts(configuration: LoopConfiguration) -> dict[str, str]:
    """Return what was simulated, in words, for the top of the page."""
    camera, r0 = configuration.camera, configuration.atmosphere.r0_m
    return _TEXT.facts(
        "loop.facts",
        configuration,
        r0=f"{r0[0]:g} to {r0[1]:g}" if isinstance(r0, tuple) else f"{r0:g}",
        nm=configuration.sensor.wavelength_m * 1e9,
        layers=len(configuration.atmosphere.fraction),
        noise=camera.read_noise_e / camera.em_gain,
        gain=f", multiplication gain {camera.em_gain:g}" if camera.em_gain > 1 else "",
    )
