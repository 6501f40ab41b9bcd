"""The tables of a study's page: cells in words and numbers, verdicts on claims, baselines, gains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.figure_data import csv_text
from faintspot.base.report.page import Badge, Cell, Section, Table
from faintspot.base.report.texts import Texts
from faintspot.experiments.curves import Gain, gain_at_error
from faintspot.experiments.methods import NO_TV, TV, TV_OVER_NO_TV, label_of
from faintspot.experiments.paper.claims import fixed_mode
from faintspot.experiments.paper.judges import LEVEL_PX
from faintspot.experiments.study.curves import (
    Configuration,
    Finding,
    Outcome,
    Verdict,
    against_tv,
    study_curves,
)
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.experiments.study.sweep import PARAMETERS
from faintspot.experiments.words import NOTHING

if TYPE_CHECKING:
    import xarray


_TEXT = Texts("faintspot.experiments")
_STATISTICS = ("gain", "rms", "corrected_rms", "outlier_fraction", "photon_efficiency")


def mode_in_words(mode: str) -> str:
    """Return "best k", "fixed k = 40", or "best gain-corrected rms"."""
    if mode == CORRECTED:
        return "best gain-corrected rms"
    return "best k" if mode == BEST else f"fixed k = {mode.removeprefix('fixed')}"


def parameters_of(dataset: xarray.Dataset, cells: Sequence[int]) -> list[dict[str, Any]]:
    """Return the physical parameters of cells."""
    columns = {name: dataset[name].values for name in PARAMETERS}
    return [{name: column[cell].item() for name, column in columns.items()} for cell in cells]


def parameter_in_words(name: str, value: Any) -> str:
    """Return a cell's parameter with its unit."""
    standard, words = _TEXT["standard_parameters"].get(name, (None, ""))
    return str(words) if value == standard else str(_TEXT[f"parameters.{name}"]).format(value)


def table_of_cells(dataset: xarray.Dataset, cells: Sequence[int]) -> tuple[list[str], list[list[Any]]]:
    """Return a table of all methods and modes of cells."""
    columns = ("chosen_k", "chosen_candidate", "invalid_fraction", *_STATISTICS)
    arrays = [
        dataset[name].transpose("cell", "mode", "estimator").values
        for name in ("error", "error_se", *columns)
    ]
    rows = []
    for cell, parameters in zip(cells, parameters_of(dataset, cells), strict=True):
        for m, mode in enumerate(dataset["mode"].values):
            for a, method in enumerate(dataset["estimator"].values):
                values = [float(array[cell, m, a]) for array in arrays]
                if np.isfinite(values[0]):
                    rows.append([*parameters.values(), str(mode), str(method), *(f"{v:.6g}" for v in values)])
    return [*PARAMETERS, "mode", "method", "R_px", "R_se_px", *columns], rows


_MOST_CASES_SHOWN = 3  # in the verdict table; the page lists all of them below it
_CASES = "cases"
_COLOURS = {Outcome.HOLDS: "good", Outcome.IN_PART: "mixed", Outcome.FAILS: "bad"}


def verdicts_section(judged: list[Verdict], fixed: str) -> Section:
    """Return the section of the verdicts; `fixed` names the mode of a fixed number of pixels."""
    title = "Verdicts on the claims of Basden et al. 2015"
    if not judged:
        return Section("verdicts", title, missing=f"No verdicts: they need the methods “{NO_TV}” and “{TV}”.")
    text = _TEXT("tables.verdicts.text", summary=_summary(judged, fixed), fixed=fixed)
    rows = [
        [
            Cell(f"{item.number}. {item.claim}", small=item.rule),
            Cell(badge=_badge(item.outcome)),
            _cell_of_mode(item.best),
            _cell_of_mode(item.fixed),
        ]
        for item in judged
    ]
    header = [*_TEXT["tables.verdicts.columns"], fixed.capitalize()]
    return Section("verdicts", title, [text], tables=[Table(header, rows, prose=True)])


def cases_section(judged: list[Verdict]) -> Section:
    """Return the section of all cases that the verdicts rest on."""
    title = "All cases behind the verdicts"
    cases = [
        (item, finding.mode, case)
        for item in judged
        for finding in (item.best, item.fixed)
        for case in finding.cases
    ]
    if not cases:
        return Section(_CASES, title, missing="There are none.")
    data = [
        [item.number, item.claim, mode, case.where, case.finding, case.outcome.value]
        for item, mode, case in cases
    ]
    table = Table(
        ["Claim", "mode", "where", "finding", "outcome"],
        [
            [str(item.number), mode_in_words(mode), case.where, case.finding, case.outcome.value]
            for item, mode, case in cases
        ],
        prose=True,
        csv=("verdicts.csv", csv_text(["number", "claim", "mode", "where", "finding", "outcome"], data)),
        folded=f"{len(cases)} cases",
    )
    return Section(_CASES, title, tables=[table])


def baselines_section(dataset: xarray.Dataset) -> Section:
    """Return the section that compares TV with every other method."""
    title = "TV and the other methods"
    modes = [mode for mode in ("best", fixed_mode(dataset)) if mode in dataset["mode"].values]
    rows = [
        [
            label_of(row.method),
            row.profile,
            mode_in_words(mode),
            str(row.cells),
            str(row.smaller),
            str(row.larger),
            str(row.cells - row.smaller - row.larger),
            str(row.smallest),
            f"{row.mean_ratio:.3f}",
        ]
        for mode in modes
        for row in against_tv(dataset, mode)
    ]
    if not rows:
        why = "Nothing to compare: TV or all others are not in this study."
        return Section("baselines", title, missing=why)
    return Section("baselines", title, tables=[_TEXT.table("tables.baselines", rows)])


def gains_section(dataset: xarray.Dataset) -> Section:
    """Return the section of the flux gain, for every way to choose the number of pixels."""
    title = "Flux gain of TV for every way to choose k"
    modes = [str(mode) for mode in dataset["mode"].values]
    rows = [
        [
            configuration.in_words(),
            *(NOTHING if (gain := gains.get(mode)) is None else gain.in_words() for mode in modes),
        ]
        for configuration, gains in gains_by_mode(dataset).items()
    ]
    if not rows:
        why = "No configuration of this study has the error 0.15 px within its fluxes."
        return Section("gains", title, missing=why)
    table = _TEXT.table("tables.gains", rows, [mode_in_words(mode) for mode in modes])
    return Section("gains", title, tables=[table])


def gains_by_mode(dataset: xarray.Dataset) -> dict[Configuration, dict[str, Gain | None]]:
    """Return the flux gain of TV over no denoising at R = `LEVEL_PX`, by configuration and mode.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of a study.

    Returns
    -------
    dict
        Configurations that have a gain in at least one mode; None where a mode has none, as when the error
        without denoising does not come down to that level.
    """
    rng = np.random.default_rng(0)  # of the bootstrap: the same study gives the same page
    table: dict[Configuration, dict[str, Gain | None]] = {}
    for mode in dataset["mode"].values:
        for configuration, curve in study_curves(dataset, str(mode)).items():
            gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV) if curve.has(TV, NO_TV) else None
            table.setdefault(configuration, {})[str(mode)] = gain
    return {key: gains for key, gains in table.items() if any(gain is not None for gain in gains.values())}


def _summary(judged: list[Verdict], fixed: str) -> str:
    def counted(outcomes: list[Outcome]) -> str:
        counts = [(outcome.value, outcomes.count(outcome)) for outcome in Outcome]
        return ", ".join(f"{outcome} {n}" for outcome, n in counts if n)

    best, at_fixed, together = (
        counted([getattr(item, name).outcome if name else item.outcome for item in judged])
        for name in ("best", "fixed", "")
    )
    return f"Of {len(judged)} claims: best k: {best}; {fixed}: {at_fixed}; both together: {together}"


def _badge(outcome: Outcome) -> Badge:
    return Badge(outcome.value, _COLOURS.get(outcome, "grey"))


def _cell_of_mode(finding: Finding) -> Cell:
    """Return a mode's outcome and its first cases, of different outcomes where there are any."""
    shown = list({case.outcome: case for case in reversed(finding.cases)}.values())[::-1]
    shown += [case for case in finding.cases if case not in shown]
    shown = sorted(shown[:_MOST_CASES_SHOWN], key=list(finding.cases).index)
    more = len(finding.cases) - len(shown)
    return Cell(
        finding.in_words(),
        _badge(finding.outcome),
        items=[(f"{case.finding} – {case.outcome.value}", case.where) for case in shown],
        link=(_CASES, f"and {more} more") if more else None,
    )
