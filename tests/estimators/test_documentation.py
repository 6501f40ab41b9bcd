"""The page of the configuration includes the options of every estimator."""

from __future__ import annotations

from pathlib import Path

from faintspot.estimators.documentation import all_tables
from faintspot.pipeline.settings import SharedOptions

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


def test_every_table_is_included() -> None:
    text = PAGE.read_text(encoding="utf-8")
    tables = {name for name, table in all_tables(SharedOptions).items() if "\n| `" in table} - {"estimators"}
    assert {name for name in tables if f"{{include}} reference/options/{name}.md" not in text} == set()
    assert "{include} reference/options/control.md" in text
