"""Claims of Basden et al. 2015 (arXiv:1503.06043), the rules of their verdicts, and when to use TV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.files import csv_text
from faintspot.base.report.page import Section
from faintspot.base.report.texts import NOTHING, Texts
from faintspot.base.statistics import magnitudes
from faintspot.experiments.curves import Gain, gain_at_error
from faintspot.experiments.methods import NO_TV, SMOOTHING, TV, TV_OVER_NO_TV, label_of
from faintspot.experiments.night.analysis import OPEN
from faintspot.experiments.night.analysis import verdicts as night_verdicts
from faintspot.experiments.night.page import paper_sentences
from faintspot.experiments.night.paper import compare_with_paper
from faintspot.experiments.paper import judges
from faintspot.experiments.paper.judges import LEVEL_PX, Curves
from faintspot.experiments.study.curves import (
    Judgement,
    Outcome,
    StudyConditions,
    Verdict,
    against_tv,
    names_of,
    parameter_in_words,
    study_curves,
)
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.experiments.study.sweep import PARAMETERS

if TYPE_CHECKING:
    import xarray

    from faintspot.experiments.night.protocol import Night


FIXED_MODE = "fixed40"
_SEED = 2015  # of the bootstraps: the same study always gets the same verdicts


def fixed_mode(dataset: xarray.Dataset) -> str:
    """Return the mode of one k for all methods that is shown: k = 40, or else the largest of the study."""
    fixed = [name for name in names_of(dataset, "mode") if name.startswith("fixed")]
    return FIXED_MODE if FIXED_MODE in fixed or not fixed else fixed[-1]


def verdicts(dataset: xarray.Dataset) -> list[Verdict]:
    """Return the verdict on every claim of the paper; cells that are not finished do not count."""
    if not {NO_TV, TV} <= {*names_of(dataset, "estimator")}:
        return []
    results = []
    for number, (text, judge) in enumerate(zip(_TEXT["claims"], judges.JUDGES, strict=True), start=1):
        rule = text["rule"].format(level=LEVEL_PX, equal=judges.EQUAL)
        findings = []
        for mode in (BEST, fixed_mode(dataset)):
            rng = np.random.default_rng([_SEED, number])
            is_measured = mode in names_of(dataset, "mode")
            findings.append(Judgement(mode, list(judge(dataset, mode, rng)) if is_measured else []))
        results.append(Verdict(number, text["claim"], rule, *findings))
    return results


_TEXT = Texts("faintspot.experiments")
_WORTH_IT = 1.1
"""Flux gain from which the cost of denoising is called worth it."""
_MOST_LISTED = 4


@dataclass(frozen=True)
class _Compared:
    """The gain of TV over no denoising and over Gaussian smoothing, for one configuration."""

    configuration: StudyConditions
    gain: Gain
    over_gaussian: Gain | None


def guidance(dataset: xarray.Dataset) -> list[str]:
    """Return paragraphs that say when a user should use TV; one, without TV and brightest pixels."""
    methods = {*names_of(dataset, "estimator")}
    if not {NO_TV, TV} <= methods:
        return [_TEXT["guidance.no_tv"]]
    rng = np.random.default_rng(_SEED)
    curves = study_curves(dataset, BEST)
    best = _compared(curves, rng, SMOOTHING in methods)
    if not best:
        return [_TEXT("guidance.no_gains", level=LEVEL_PX)]
    paragraphs = [_flux_gains("brightest pixels alone", [item.gain for item in best])]
    over_gaussian = [item.over_gaussian for item in best if item.over_gaussian is not None]
    if over_gaussian:
        paragraphs.append(_flux_gains("Gaussian smoothing of the best width", over_gaussian))
    fixed = fixed_mode(dataset)
    if fixed in dataset["mode"].values:
        paragraphs += _choosing_k(curves, study_curves(dataset, fixed), fixed)
    return [*paragraphs, _recommendation(best)]


def _compared(curves: Curves, rng: np.random.Generator, gaussian: bool) -> list[_Compared]:
    compared = []
    for key, curve in sorted(curves.items()):
        gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV)
        if gain is None or not np.isfinite(gain.log_se):
            continue
        gain_over = gain_at_error(curve, LEVEL_PX, rng, method=TV, reference=SMOOTHING) if gaussian else None
        is_known = gain_over is not None and np.isfinite(gain_over.log_se)
        compared.append(_Compared(key, gain, gain_over if is_known else None))
    return compared


def _flux_gains(reference: str, gains: list[Gain]) -> str:
    """Return in how many configurations TV needs less flux than a reference, and the median gain."""
    better, worse = sum(gain.low > 1 for gain in gains), sum(gain.high < 1 for gain in gains)
    factors = np.array([gain.factor for gain in gains])
    median = float(np.median(factors))
    counts = {"better": better, "worse": worse, "all": len(gains), "undecided": len(gains) - better - worse}
    values = {
        "least": factors.min(),
        "most": factors.max(),
        "median": median,
        "magnitudes": magnitudes(median),
    }
    return _TEXT("guidance.flux_gains", level=LEVEL_PX, reference=reference, **counts, **values)


def _choosing_k(best: Curves, fixed: Curves, mode: str) -> list[str]:
    """Describe the gain of a good number of pixels kept, without denoising."""
    ratios = []
    for key, curve in best.items():
        if key in fixed:
            error, fixed_error = curve.of(NO_TV), fixed[key].of(NO_TV)
            usable = np.isfinite(error) & np.isfinite(fixed_error) & (fixed_error < 0.8 * key.prior_error_px)
            ratios += (fixed_error[usable] / error[usable]).tolist()
    if not ratios:
        return []
    k = mode.removeprefix("fixed")
    return [_TEXT("guidance.choosing_k", k=k, median=np.median(ratios), most=max(ratios))]


def _recommendation(best: list[_Compared]) -> str:
    worth = [item for item in best if item.gain.low > _WORTH_IT]
    use = [item for item in worth if item.over_gaussian is None or item.over_gaussian.low > 1]
    counts = {"worth": _WORTH_IT, "all": len(best)}
    if not use:
        advice = _TEXT["guidance.advice_smoothing" if worth else "guidance.advice_against"]
        return str(advice.format(**counts, count=len(worth)))
    use.sort(key=lambda item: -item.gain.low)
    listed = [f"{item.configuration.in_words()}: {item.gain.in_words()}" for item in use[:_MOST_LISTED]]
    if len(use) > _MOST_LISTED:
        listed.append(f"and {len(use) - _MOST_LISTED} more")
    return _TEXT("guidance.advice_for", **counts, count=len(use), listed="; ".join(listed))


def mode_in_words(mode: str) -> str:
    """Return "best k", "fixed k = 40", or "best gain-corrected rms"."""
    if mode == CORRECTED:
        return "best gain-corrected rms"
    return "best k" if mode == BEST else f"fixed k = {mode.removeprefix('fixed')}"


def parameters_of(dataset: xarray.Dataset, cells: Sequence[int]) -> list[dict[str, Any]]:
    """Return the physical parameters of cells."""
    columns = {name: dataset[name].values for name in PARAMETERS}
    return [{name: column[cell].item() for name, column in columns.items()} for cell in cells]


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
        if mode in names_of(dataset, "mode")
        for row in against_tv(dataset, mode)
    ]
    return _TEXT.section("baselines", _TEXT.table("baselines", records))


def gains_section(dataset: xarray.Dataset) -> Section:
    """Return the section of the flux gain, for every way to choose the number of pixels."""
    modes = names_of(dataset, "mode")
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
    for mode in names_of(dataset, "mode"):
        for configuration, curve in study_curves(dataset, mode).items():
            gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV) if curve.has(TV, NO_TV) else None
            table.setdefault(configuration, {})[mode] = gain
    return {key: gains for key, gains in table.items() if any(gain is not None for gain in gains.values())}


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
    named = (
        (verdict.best, "best k", _TEXT["whole.best"]),
        (verdict.fixed, f"k = {fixed}", _TEXT("whole.fixed", k=fixed)),
    )
    measured = [each for each in named if each[0].cases]
    outcomes = {case.outcome for finding, *_ in measured for case in finding.cases}
    if not outcomes:
        return PaperRow(part, verdict.claim, verdict.rule, NOT_MEASURED, "", "")
    word, condition = HOLDS, ""
    if outcomes != {Outcome.HOLDS}:
        word = HOLDS_IF if Outcome.HOLDS in outcomes else FAILS
        condition = "; ".join(_share(finding, where) for finding, _, where in measured)
    numbers = "; ".join(f"{name}: {_typical(finding)}" for finding, name, _ in measured)
    return PaperRow(part, verdict.claim, verdict.rule, word, condition, numbers)


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
