"""Results of benchmarks survive being written and read, and an interrupted run keeps what was finished."""

import json
import sys
from datetime import date
from pathlib import Path
from types import ModuleType

import pytest
from benchmarks import __main__ as command
from benchmarks import machine, results
from benchmarks.loops import night_frames
from benchmarks.measuring import Table
from benchmarks.paper import paper_night
from click.testing import CliRunner
from tests import benchmark_cases as cases
from tests.experiments.night_cases import night_with

from faintspot.base.report.texts import with_error
from faintspot.experiments.night.paper import compare_with_paper
from faintspot.experiments.night.protocol import NightPlan


def test_written_and_read_again_they_are_the_same(tmp_path: Path) -> None:
    found = cases.results()
    path = results.write(found, tmp_path / "new" / "folder")
    assert results.read(path) == found
    assert path.name == f"2026-01-02T030405-{machine.short(found.fingerprint)}.json"
    assert list(path.parent.iterdir()) == [path]


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `rivals` find something, `scale` fail and `estimators` be interrupted."""

    def fail() -> list[Table]:
        raise AssertionError("differs\nby much")

    def interrupt() -> list[Table]:
        raise KeyboardInterrupt

    runs = {"rivals": lambda: [cases.rivals_table()], "scale": fail, "estimators": interrupt}
    for name, run in runs.items():
        module = ModuleType(command.MODULES[name], "What it is.\n\nHow it is measured.")
        module.run = run  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)


def options(folder: Path) -> list[str]:
    """Return options that write into a folder only."""
    return ["--folder", str(folder), "--pages", str(folder / "pages")]


@pytest.mark.usefixtures("made_up")
def test_a_benchmark_that_fails_does_not_end_the_others(tmp_path: Path) -> None:
    answer = CliRunner().invoke(command.run, ["scale", "rivals", *options(tmp_path)])
    assert answer.exit_code == 1
    assert "[2/2] rivals" in answer.output
    (path,) = results.newest_first(tmp_path)
    found = results.read(path)
    assert [each.failure for each in found.benchmarks] == ["AssertionError: differs", ""]


@pytest.mark.usefixtures("made_up")
def test_named_benchmarks_write_what_the_pages_show(tmp_path: Path) -> None:
    pages = tmp_path / "pages"
    pages.mkdir()
    kept = {"title": "Other", "rows": [["a", "1"]]}
    (pages / "rivals.json").write_text(json.dumps({"answer": "fast", "tables": {"other": kept}}))
    assert CliRunner().invoke(command.run, ["rivals", *options(tmp_path)]).exit_code == 0
    data = json.loads((pages / "rivals.json").read_text())
    assert data["answer"] == "fast"
    assert data["tables"].pop("other") == kept
    (table,) = data["tables"].values()
    expected = cases.rivals_table()
    assert [row[0] for row in table["rows"]] == [row.name for row in expected.rows]
    assert table["columns"][1] in expected.rows[0].values
    assert table["measured"] == date.today().isoformat()
    assert table["processor"] == machine.fingerprint()["processor"]
    assert table["command"] == "python -m benchmarks rivals"


@pytest.mark.usefixtures("made_up")
def test_an_interrupted_run_keeps_what_was_finished(tmp_path: Path) -> None:
    answer = CliRunner().invoke(command.run, ["rivals", "estimators", *options(tmp_path)])
    assert answer.exit_code == 1
    (path,) = results.newest_first(tmp_path)
    assert [each.name for each in results.read(path).benchmarks] == ["rivals"]


def test_nights_of_all_packages_are_what_the_documentation_shows(tmp_path: Path) -> None:
    table = "| frames | r0 / true |\n|---|---|\n| soapy, 20 e- | 0.92, 0.91 |\n\nWithin the goals: r0 50 %."
    stored = json.loads(night_frames.publish(table, "now", tmp_path / "pages").read_text(encoding="utf-8"))
    assert stored["tables"]["nights"]["columns"] == ["frames", "r0 / true"]
    assert stored["tables"]["nights"]["rows"] == [["soapy, 20 e-", "0.92, 0.91"]]


@pytest.mark.slow
def test_both_nights_stand_beside_the_papers_table(tmp_path: Path) -> None:
    (tmp_path / "paper.json").write_bytes((results.PAGES / "paper.json").read_bytes())
    nights = [night_with(seed, plan=NightPlan()) for seed in (1, 2)]
    stored = json.loads(paper_night.publish(nights[0], nights[1], tmp_path).read_text(encoding="utf-8"))
    compared = [compare_with_paper(night) for night in nights]
    means, beside = stored["tables"]["night"], stored["tables"]["night_paper"]
    assert [row[1] for row in means["rows"]][:2] == ["0.184 ± 0.001 (2)", "0.203 ± 0.012 (2)"]
    for column, each in zip((2, 3), compared, strict=True):
        assert each is not None
        assert beside["rows"][4][column] == with_error(each.every.our_mean, sign=True)
        assert beside["rows"][5][column].startswith(f"{each.every.chi_square:.1f} (")
    of_study = [row for row in stored["tables"]["verdicts"]["rows"] if not row[0].startswith("Section 3.7")]
    assert len(of_study) == 8
    assert len(stored["tables"]["verdicts"]["rows"]) == 8 + 5
    assert "paper" in stored["figures"]["in_counts"]
