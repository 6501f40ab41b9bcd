"""The benchmark of foreign loops runs; nothing is asserted of who wins."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from benchmarks.loops.foreign import evaluation, rows
from benchmarks.loops.foreign.evaluation import INTEGRATOR
from benchmarks.loops.foreign.oopao import OopaoCase
from benchmarks.loops.foreign_loops import publish, run_command, table_of
from click.testing import CliRunner

from faintspot.loop.telemetry.choices import FILTER


@pytest.mark.slow
def test_a_quick_row_is_stored_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a smaller telescope; scored are 60 frames, whose Strehl ratio is far from that without a mirror."""
    pytest.importorskip("OOPAO")
    case = OopaoCase("small", lenslets=5, lenslet_px=8, diameter_m=3.0)
    monkeypatch.setattr(rows, "ROWS", [rows.Row("oopao-20", "small", partial(rows._oopao, case))])
    monkeypatch.setattr(evaluation, "QUICK", evaluation.Effort(210, 3.0, (3,), (0.4,), with_others=False))
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


def test_scores_of_all_rows_are_what_the_documentation_shows(tmp_path: Path) -> None:
    result = {
        "title": "OOPAO: 20 e-",
        "scores": {INTEGRATOR: [0.5, 0.6], FILTER: [0.7, 0.8]},
        "chosen": {INTEGRATOR: "gain 0.4"},
        "ahead": {INTEGRATOR: [0.2, 0.01]},
    }
    (tmp_path / "all.json").write_text(json.dumps([result, {"failure": "InputError: no"}]))
    stored = json.loads(publish(tmp_path, tmp_path / "pages").read_text(encoding="utf-8"))
    assert stored["tables"]["loops"]["rows"] == [
        ["OOPAO: 20 e-", "0.550 (0.4)", "**0.750**", "+0.200 ± 0.010"]
    ]
