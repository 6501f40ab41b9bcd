"""The benchmark of foreign loops runs; nothing is asserted of who wins."""

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.foreign_loops import run_command, table_of
from click.testing import CliRunner


@pytest.mark.slow
def test_a_quick_row_is_stored_and_shown(tmp_path: Path) -> None:
    pytest.importorskip("OOPAO")
    options = ["--rows", "oopao-20", "--quick", "--folder", str(tmp_path)]
    first = CliRunner().invoke(run_command, options)
    assert first.exit_code == 0, first.output
    result = json.loads((tmp_path / "oopao-20.json").read_text(encoding="utf-8"))
    assert "failure" not in result
    assert np.mean(result["scores"]["integrator"]) > 0.4  # without a mirror 0.05
    assert "oopao-20" in (tmp_path / "table.md").read_text(encoding="utf-8")
    again = CliRunner().invoke(run_command, options)
    assert "in " in again.output
    assert "learnt in" not in again.output


def test_an_unknown_row_is_refused() -> None:
    result = CliRunner().invoke(run_command, ["--rows", "mine"])
    assert result.exit_code == 2
    assert "no row mine" in result.output


def test_a_failed_row_is_in_the_table() -> None:
    table = table_of([{"name": "oopao-20", "failure": "InputError: no", "seconds": 60.0}])
    assert "| oopao-20 | failed: InputError: no |" in table
