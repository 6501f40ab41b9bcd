"""The report page of a closed-loop experiment: one HTML text that needs nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, Page, Section, configuration_section, write_page
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.figures import (
    budget_figure,
    gain_figure,
    magnitude_figure,
    strehl_axis,
)
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
    options_that_may_pay,
    reference_methods,
)
from faintspot.experiments.words import with_interval
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration

_TEXT = Texts("faintspot.experiments")
_FEW_REALISATIONS = 5
_SLOPE_ERROR = "slope error"
_NOT_RUN = "Not run: {} does that."


def loop_sections(results: LoopResults) -> list[Section]:
    """Return all sections in the page's order."""
    magnitude, budget = results.magnitude, results.budget
    lines = loop_verdict(results)
    sections = [
        Section("verdict", "What was found", lines, missing="" if lines else "Nothing to compare yet.")
    ]
    if magnitude is None:
        sections.append(_missing("magnitude", "Strehl against magnitude", "magnitude"))
    else:
        sections += _magnitude(magnitude)
    sections.append(
        _missing("budget", "Error budget", "budget") if budget is None else _budget(budget, results)
    )
    return sections


def loop_warnings(results: LoopResults) -> list[str]:
    """Return what a reader should know before the results: what is unfinished or too little."""
    lines = []
    for name, strehl in (
        ("Strehl against magnitude", None if results.magnitude is None else results.magnitude.strehl),
        ("Error budget", None if results.budget is None else results.budget.strehl),
    ):
        if strehl is None:
            continue
        missing = int(np.isnan(strehl).sum())
        if missing:
            lines.append(_TEXT("loop.unfinished", name=name, missing=missing, runs=strehl.size))
        if strehl.shape[-1] < _FEW_REALISATIONS:
            few = {"count": strehl.shape[-1], "fewest": _FEW_REALISATIONS}
            lines.append(_TEXT("loop.few_realisations", name=name, **few))
    return lines


def configuration_text(results: LoopResults) -> str:
    """Return the configuration of the experiments as TOML text; "" when not known."""
    return "" if results.magnitude is None else results.magnitude.configuration


def configuration_of(results: LoopResults) -> LoopConfiguration | None:
    """Return the configuration, or None when it is not known."""
    text = configuration_text(results)
    try:
        return LoopConfiguration.from_text(text) if text else None
    except InputError:
        return None


def _missing(name: str, title: str, command: str) -> Section:
    return Section(name, title, missing=_NOT_RUN.format(f"“faintspot loop {command}”"))


def _magnitude(result: MagnitudeResult) -> list[Section]:
    references = reference_methods(result)
    base = " and then with ".join(result.labels[method] for method in references)
    wavelength = LoopConfiguration.from_text(result.configuration).science.wavelength_m
    tables = [strehl_table(result)]
    for rank, reference in enumerate(references):
        compared = [method for method in range(len(result.labels)) if method not in references[: rank + 1]]
        tables += [
            gain_table(result, compared, reference),
            difference_table(result, [(method, reference) for method in compared]),
        ]
    pairs = [(method, without) for _, method, without in options_that_may_pay(result)]
    if pairs:
        table = difference_table(result, pairs)
        tables.append(replace(table, caption=_TEXT["tables.difference.options"] + table.caption))
    methods, fluxes, realisations = result.strehl.shape
    counts = {"methods": methods, "fluxes": fluxes, "realisations": realisations}
    text = [_TEXT("loop.magnitude", **counts, reference=base)]
    return [
        Section(
            "magnitude",
            "Strehl against magnitude",
            text,
            tables,
            [magnitude_figure(result, references[0], strehl_axis(wavelength))],
        ),
        Section("gain", "Centroid gain", tables=[centroid_gain_table(result)], figures=[gain_figure(result)]),
        Section("settings", "Tuned settings", tables=[settings_table(result)]),
    ]


def _budget(result: BudgetResult, results: LoopResults) -> Section:
    configuration = configuration_of(results)
    label = strehl_axis(1.65e-6 if configuration is None else configuration.science.wavelength_m)
    text = _budget_lines(result)
    return Section("budget", "Error budget", text, [budget_table(result)], [budget_figure(result, label)])


def _budget_lines(result: BudgetResult) -> list[str]:
    """Describe which term costs each method most Strehl, and how differences between methods change."""
    lines = []
    changes = result.strehl - result.strehl[:, :1]
    for method, name in enumerate(result.labels):
        gains = [paired_mean(runs) for runs in changes[method]]
        order = sorted(range(1, len(gains)), key=lambda number: -np.nan_to_num(gains[number].value))
        parts = [f"{result.terms[n]} {with_interval(gains[n])}" for n in order[:3] if gains[n].decided > 0]
        if parts:
            lines.append(f"{name}: most Strehl is gained without {', then '.join(parts)}.")
        if _SLOPE_ERROR in result.terms:
            most = with_interval(gains[result.terms.index(_SLOPE_ERROR)])
            lines.append(_TEXT("loop.true_slopes", name=name, change=most))
    for method, name in enumerate(result.labels[1:], start=1):
        parts = [
            f"{_without(number, term)} {with_interval(paired_mean(difference))}"
            for number, (term, difference) in enumerate(
                zip(result.terms, result.strehl[method] - result.strehl[0], strict=True)
            )
        ]
        lines.append(f"{name} less {result.labels[0]}: {'; '.join(parts)}.")
    return lines


def _without(number: int, term: str) -> str:
    return f"without {term}" if number else "in the whole loop"


def write_loop_report(folder_of_results: str | Path, out_html: str | Path) -> list[Path]:
    """Write the report of what `faintspot loop` left in a folder, finished or not, as `write_page` does.

    Raises
    ------
    InputError
        When there are no results, or a file cannot be written.
    """
    return write_page(loop_page(LoopResults.load(folder_of_results)), out_html)


def loop_page(results: LoopResults) -> Page:
    """Return the report page of closed-loop results."""
    configuration = configuration_of(results)
    name = "" if configuration is None else f": “{configuration.name}”"
    return Page(
        title=f"Closed loop with and without TV{name}",
        facts=_facts(results),
        sections=[*loop_sections(results), configuration_section(configuration_text(results))],
        warnings=loop_warnings(results),
        remark=POSITIONS,
    )


def _facts(results: LoopResults) -> dict[str, str]:
    """Return what was simulated, in words, for the top of the page."""
    configuration = configuration_of(results)
    if configuration is None:
        return {}
    camera, r0 = configuration.camera, configuration.atmosphere.r0_m
    values = {
        **{name: getattr(configuration, name) for name in ("telescope", "sensor", "atmosphere", "control")},
        "r0": f"{r0[0]:g} to {r0[1]:g}" if isinstance(r0, tuple) else f"{r0:g}",
        "side": configuration.subaperture_m,
        "nm": configuration.sensor.wavelength_m * 1e9,
        "layers": len(configuration.atmosphere.fraction),
        "noise": camera.read_noise_e / camera.em_gain,
        "gain": f", multiplication gain {camera.em_gain:g}" if camera.em_gain > 1 else "",
        "photons": configuration.photons,
        "science_um": configuration.science.wavelength_m * 1e6,
    }
    return {name: _TEXT(f"loop.facts.{name}", **values) for name in _TEXT["loop.facts"]}
