"""The tables in the documentation are those of the declarations."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from faintspot.estimators.documentation import all_tables
from faintspot.pipeline.settings import SharedOptions

DOCS = Path(__file__).parents[2] / "docs"
TABLE = re.compile(r"<!-- options: (\w+) -->\n(.*?)\n<!-- end -->", re.DOTALL)


@pytest.mark.parametrize("page", ["configuration.md", "estimators.md"])
def test_tables_are_up_to_date(page: str) -> None:
    tables = all_tables(SharedOptions)
    found = TABLE.findall((DOCS / page).read_text(encoding="utf-8"))
    assert found
    for name, text in found:
        assert text == tables[name], f"{page}: {name}: `faintspot estimators --markdown` prints what to put"
