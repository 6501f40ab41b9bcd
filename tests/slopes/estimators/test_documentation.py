"""The page of the configuration includes the options of every estimator."""

from tests.shared_data import ROOT

from faintspot.slopes.estimators.registry import all_tables
from faintspot.slopes.pipeline.settings import SharedOptions

PAGE = ROOT / "docs" / "configuration.md"


def test_every_table_is_included() -> None:
    text = PAGE.read_text(encoding="utf-8")
    tables = {name for name, table in all_tables(SharedOptions).items() if "\n| `" in table} - {"estimators"}
    assert {name for name in tables if f"{{include}} reference/options/{name}.md" not in text} == set()
    assert "{include} reference/options/control.md" in text
