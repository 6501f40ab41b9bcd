"""The report page of a closed-loop experiment: one HTML text that needs nothing else."""

from __future__ import annotations

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, Report, Section, configuration_section
from faintspot.base.report.texts import Texts, with_interval
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.figures import magnitude_figure, strehl_axis
from faintspot.experiments.closed_loop.results import BudgetResult, MagnitudeResult
from faintspot.experiments.closed_loop.tables import (
    budget_table,
    centroid_gain_table,
    difference_table,
    gain_table,
    settings_table,
    strehl_table,
)
from faintspot.experiments.closed_loop.verdict import (
    LoopResults,
    loop_verdict,
    reference_methods,
)
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration

_TEXT = Texts("faintspot.experiments")
_FEW_REALISATIONS = 5


def loop_page(results: LoopResults) -> Report:
    """Return the report page of closed-loop results."""
    text = "" if results.magnitude is None else results.magnitude.configuration
    configuration = _configuration(text)
    wavelength_m = 1.65e-6 if configuration is None else configuration.science.wavelength_m
    name = "" if configuration is None else f": “{configuration.name}”"
    return Report(
        f"Closed loop with and without TV{name}",
        {} if configuration is None else _facts(configuration),
        [*_sections(results, strehl_axis(wavelength_m)), configuration_section(text)],
        loop_warnings(results),
        remark=POSITIONS,
    )


def loop_warnings(results: LoopResults) -> list[str]:
    """Return what a reader should know before the results: what is unfinished or too little."""
    lines = []
    for name, result in (("magnitude", results.magnitude), ("budget", results.budget)):
        if result is not None:
            missing, count = int(np.isnan(result.strehl).sum()), result.strehl.shape[-1]
            lines += _TEXT.lines(
                "loop.warnings",
                name=_TEXT[f"{name}.title"],
                missing=missing or None,
                runs=result.strehl.size,
                few=count if count < _FEW_REALISATIONS else None,
                fewest=_FEW_REALISATIONS,
            )
    return lines


def _sections(results: LoopResults, strehl: str) -> list[Section]:
    """Return all sections in the page's order; `strehl` is the label of an axis."""
    magnitude, budget = results.magnitude, results.budget
    return [
        _TEXT.section("verdict", *loop_verdict(results)),
        *([_TEXT.section("magnitude")] if magnitude is None else _of_magnitudes(magnitude, strehl)),
        _TEXT.section("budget")
        if budget is None
        else _TEXT.section("budget", *_budget_lines(budget), budget_table(budget)),
    ]


def _of_magnitudes(result: MagnitudeResult, strehl: str) -> list[Section]:
    references = reference_methods(result)
    base = " and then with ".join(result.labels[method] for method in references)
    tables = [strehl_table(result)]
    for rank, reference in enumerate(references):
        compared = [method for method in range(len(result.labels)) if method not in references[: rank + 1]]
        tables.append(gain_table(result, compared, reference))
        if rank:  # the figure has the differences from the first reference
            tables.append(difference_table(result, [(method, reference) for method in compared]))
    figure = magnitude_figure(result, references[0], strehl)
    return [
        _TEXT.section("magnitude", *tables, figure, shape=result.strehl.shape, reference=base),
        _TEXT.section("gain", centroid_gain_table(result)),
        _TEXT.section("settings", settings_table(result)),
    ]


def _budget_lines(result: BudgetResult) -> list[str]:
    """Return how the differences between methods change with each term switched off."""
    lines = []
    for name, strehl in zip(result.labels[1:], result.strehl[1:], strict=True):
        less = map(paired_mean, strehl - result.strehl[0])
        where = ["in the whole loop", *(f"without {term}" for term in result.terms[1:])]
        parts = [f"{term} {with_interval(change)}" for term, change in zip(where, less, strict=True)]
        lines.append(f"{name} less {result.labels[0]}: {'; '.join(parts)}.")
    return lines


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
        science_um=configuration.science.wavelength_m * 1e6,
    )
