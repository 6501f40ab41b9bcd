from dataclasses import asdict

import pytest
from tests.experiments.night_cases import night_with
from tests.experiments.study_cases import dataset, power_law

from faintspot.base.report.page import Table, TableCell
from faintspot.experiments.night.analysis import OPEN
from faintspot.experiments.paper.claims import (
    FAILS,
    HOLDS,
    HOLDS_IF,
    NOT_MEASURED,
    paper_markdown,
    paper_rows,
    paper_section,
)
from faintspot.experiments.study.specification import paper_study

pytest.importorskip("xarray")


def study(gain: float) -> object:
    """The quick study in which TV needs `gain` times less flux for the same error."""
    cells = [asdict(cell) for cell in paper_study(quick=True).cells()]
    return dataset(cells, power_law(lambda cell, method, mode: gain if method == "tv" else 1.0))


@pytest.mark.slow
def test_every_figure_and_the_night_are_there_in_order() -> None:
    rows = paper_rows(study(1.4), night_with(1, effect=0.2))  # type: ignore[arg-type]
    assert len(rows) == 8 + 5
    parts = [row.part for row in rows[:8]]
    assert parts == sorted(parts)
    figures = {part.split(",")[0] for part in parts}
    assert figures >= {"Figure 2", "Figure 3", "Figure 4", "Figure 5", "Figure 6", "Figure 7"}
    assert all(row.part.startswith("Section 3.7") for row in rows[8:])
    assert {row.verdict for row in rows} <= {HOLDS, HOLDS_IF, FAILS, OPEN, NOT_MEASURED}
    assert all("cases" in row.condition for row in rows if row.verdict == HOLDS_IF)
    assert not any(row.condition for row in rows if row.verdict == HOLDS)
    assert all(row.number or row.verdict == NOT_MEASURED for row in rows)


@pytest.mark.slow
def test_a_night_alone() -> None:
    rows = paper_rows(None, night_with(1, effect=0.2, best=0.2))
    assert [row.verdict for row in rows] == [HOLDS] * 4 + [OPEN]
    assert "in the same turbulence" in rows[0].number
    text = paper_markdown(rows)
    assert text.count("\n") == 2 + 5
    assert all(line.startswith("| ") and line.endswith(" |") for line in text.splitlines())
    (table,) = paper_section(rows).parts
    assert isinstance(table, Table)
    assert table.rows[0][1] == TableCell(rows[0].statement)


def test_nothing_at_all() -> None:
    assert paper_rows(None, None) == []
    assert paper_section([]).missing
