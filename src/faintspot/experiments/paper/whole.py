"""The whole paper, figure by figure: what holds, under which condition, and the number that says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.files import csv_text
from faintspot.base.report.page import Section
from faintspot.base.report.texts import NOTHING, Texts
from faintspot.experiments.curves import Gain, gain_at_error
from faintspot.experiments.methods import NO_TV, TV, TV_OVER_NO_TV, label_of
from faintspot.experiments.night.analysis import OPEN
from faintspot.experiments.night.analysis import verdicts as night_verdicts
from faintspot.experiments.night.page import paper_sentences
from faintspot.experiments.night.paper import compare_with_paper
from faintspot.experiments.paper.claims import fixed_mode, verdicts
from faintspot.experiments.paper.judges import LEVEL_PX
from faintspot.experiments.study.curves import (
    Judgement,
    Outcome,
    StudyConditions,
    Verdict,
    against_tv,
    study_curves,
)
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.experiments.study.sweep import PARAMETERS

if TYPE_CHECKING:
    import xarray

    from faintspot.experiments.night.blocks import Night


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


def parameter_in_words(name: str, value: object) -> str:
    """Return a cell's parameter with its unit."""
    standard, words = _TEXT["standard_parameters"].get(name, (None, ""))
    return str(words) if value == standard else str(_TEXT[f"parameters.{name}"]).format(value)


def in_words(names: Sequence[str], values: Sequence[object]) -> str:
    """Return parameters with their units."""
    return ", ".join(map(parameter_in_words, names, values))


def grouped(
    dataset: xarray.Dataset, cells: Sequence[int], by: Sequence[str], axis: str
) -> dict[tuple[Any, ...], list[int]]:
    """Return cells by the values of some parameters, in order, each by increasing value of another one."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    pairs = zip(cells, parameters_of(dataset, cells), strict=True)
    for cell, row in sorted(pairs, key=lambda pair: pair[1][axis]):
        groups.setdefault(tuple(row[name] for name in by), []).append(cell)
    return dict(sorted(groups.items()))


def cases_csv(judged: Sequence[Verdict]) -> tuple[str, str]:
    """Return name and text of the file with all cases that the verdicts rest on."""
    data = [
        [item.number, item.claim, finding.mode, case.where, case.finding, case.outcome.value]
        for item in judged
        for finding in (item.best, item.fixed)
        for case in finding.cases
    ]
    return "verdicts.csv", csv_text(["number", "claim", "mode", "where", "finding", "outcome"], data)


def baselines_section(dataset: xarray.Dataset) -> Section:
    """Return the section that compares TV with every other method."""
    records = [
        {
            **vars(row),
            "label": label_of(row.method),
            "mode": mode_in_words(mode),
            "undecided": row.cells - row.smaller - row.larger,
        }
        for mode in (BEST, fixed_mode(dataset))
        if mode in dataset["mode"].values
        for row in against_tv(dataset, mode)
    ]
    return _TEXT.section("baselines", _TEXT.table("baselines", records))


def gains_section(dataset: xarray.Dataset) -> Section:
    """Return the section of the flux gain, for every way to choose the number of pixels."""
    modes = [str(mode) for mode in dataset["mode"].values]
    rows = [
        [
            key.in_words(),
            *(NOTHING if (gain := gains.get(mode)) is None else gain.in_words() for mode in modes),
        ]
        for key, gains in gains_by_mode(dataset).items()
    ]
    return _TEXT.section("gains", _TEXT.table("gains", rows, [mode_in_words(mode) for mode in modes]))


def gains_by_mode(dataset: xarray.Dataset) -> dict[StudyConditions, dict[str, Gain | None]]:
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
    table: dict[StudyConditions, dict[str, Gain | None]] = {}
    for mode in dataset["mode"].values:
        for configuration, curve in study_curves(dataset, str(mode)).items():
            gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV) if curve.has(TV, NO_TV) else None
            table.setdefault(configuration, {})[str(mode)] = gain
    return {key: gains for key, gains in table.items() if any(gain is not None for gain in gains.values())}


_TEXT = Texts("faintspot.experiments")
_NIGHT = Texts("faintspot.experiments.night")
_PROVEN = 0.05  # probability below which a difference is no chance
HOLDS, HOLDS_IF, FAILS, NOT_MEASURED = "holds", "holds if", "does not hold", "not measured"


@dataclass(frozen=True)
class PaperRow:
    """A statement of the paper and what became of it."""

    part: str
    """Figure or table."""
    statement: str
    rule: str
    """Rule that decides each case; "" for the night."""
    verdict: str
    condition: str
    """Cases in which it holds; "" where nothing is to be added."""
    number: str


def paper_rows(dataset: xarray.Dataset | None, night: Night | None) -> list[PaperRow]:
    """Return every statement in the order of the paper.

    Parameters
    ----------
    dataset : xarray.Dataset, optional
        The Monte-Carlo study, finished or not.
    night : Night, optional
        The alternating observations.
    """
    rows = []
    if dataset is not None:
        fixed = fixed_mode(dataset).removeprefix("fixed")
        parts = [claim["part"] for claim in _TEXT["claims"]]
        judged = verdicts(dataset)
        rows = [_row(parts[each.number - 1], each, fixed) for each in judged]
        rows.sort(key=lambda row: row.part)
    if night is not None:
        for each in night_verdicts(night):
            word = each.paired_outcome or each.outcome
            rows.append(
                PaperRow(_TEXT["whole.night"], each.statement, "", word, "", _NIGHT("lines.number", each))
            )
        compared, sentences = compare_with_paper(night), paper_sentences(night)
        if compared is not None:
            proven = min(compared.every.chance, compared.chance_of_any) < _PROVEN
            word, statement = HOLDS if proven else OPEN, _NIGHT["statements.proof"]
            rows.append(PaperRow(_TEXT["whole.night"], statement, "", word, "", " ".join(sentences)))
    return rows


def paper_section(rows: Sequence[PaperRow], judged: Sequence[Verdict] = ()) -> Section:
    """Return the section of the whole paper for a page, with all cases of verdicts as a file."""
    table = _TEXT.table("paper", rows)
    return _TEXT.section("paper", replace(table, csv=cases_csv(judged)) if judged else table)


def paper_markdown(rows: Sequence[PaperRow]) -> str:
    """Return the table of the whole paper as Markdown."""
    header = list(_TEXT["paper.columns"])
    table = [header, ["---"] * len(header)]
    for row in rows:
        condition = f"<br>{row.condition}" if row.condition else ""
        table.append([row.part, row.statement, f"**{row.verdict}**{condition}", row.number])
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in table)


def _row(part: str, verdict: Verdict, fixed: str) -> PaperRow:
    outcomes = {case.outcome for finding in (verdict.best, verdict.fixed) for case in finding.cases}
    if not outcomes:
        return PaperRow(part, verdict.claim, verdict.rule, NOT_MEASURED, "", "")
    condition = ""
    if outcomes == {Outcome.HOLDS}:
        word = HOLDS
    else:
        word = HOLDS_IF if Outcome.HOLDS in outcomes else FAILS
        shares = [(verdict.best, _TEXT["whole.best"]), (verdict.fixed, _TEXT("whole.fixed", k=fixed))]
        condition = "; ".join(_share(finding, where) for finding, where in shares if finding.cases)
    numbers = [
        f"{name}: {_typical(finding)}"
        for name, finding in (("best k", verdict.best), (f"k = {fixed}", verdict.fixed))
        if finding.cases
    ]
    return PaperRow(part, verdict.claim, verdict.rule, word, condition, "; ".join(numbers))


def _share(finding: Judgement, where: str) -> str:
    """Return in how many cases a claim holds."""
    counts = [sum(case.outcome is outcome for case in finding.cases) for outcome in Outcome]
    holds, in_part = counts[0], counts[1]
    part = f" ({in_part} in part)" if in_part else ""
    return f"{where}: {holds} of {len(finding.cases)} cases{part}"


def _typical(finding: Judgement) -> str:
    """Return the number of the first case with the most frequent outcome, and where it was found."""
    outcomes = [case.outcome for case in finding.cases]
    case = finding.cases[outcomes.index(max(outcomes, key=outcomes.count))]
    return f"{case.finding} ({case.where})"
