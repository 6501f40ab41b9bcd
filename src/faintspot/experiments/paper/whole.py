"""The whole paper, figure by figure: what holds, under which condition, and the number that says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from faintspot.base.report.page import Section
from faintspot.base.report.texts import Texts
from faintspot.experiments.night.analysis import OPEN
from faintspot.experiments.night.analysis import verdicts as night_verdicts
from faintspot.experiments.night.page import paper_sentences
from faintspot.experiments.night.paper import compare_with_paper
from faintspot.experiments.paper.claims import fixed_mode, verdicts
from faintspot.experiments.paper.tables import cases_csv
from faintspot.experiments.study.curves import Judgement, Outcome, Verdict

if TYPE_CHECKING:
    import xarray

    from faintspot.experiments.night.blocks import Night

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
