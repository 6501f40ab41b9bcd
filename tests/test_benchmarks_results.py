"""Results of benchmarks survive being written and read, and an interrupted run keeps what was finished."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
from benchmarks import __main__ as command
from benchmarks import machine, results
from benchmarks.measuring import Table
from click.testing import CliRunner
from tests import benchmark_cases as cases


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
        module = ModuleType(f"benchmarks.{name}", "What it is.\n\nHow it is measured.")
        module.run = run  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, f"benchmarks.{name}", module)


@pytest.mark.usefixtures("made_up")
def test_a_benchmark_that_fails_does_not_end_the_others(tmp_path: Path) -> None:
    answer = CliRunner().invoke(command.run, ["scale", "rivals", "--folder", str(tmp_path)])
    assert answer.exit_code == 1
    assert "[2/2] rivals" in answer.output
    (path,) = results.newest_first(tmp_path)
    found = results.read(path)
    assert [each.failure for each in found.benchmarks] == ["AssertionError: differs", ""]


@pytest.mark.usefixtures("made_up")
def test_an_interrupted_run_keeps_what_was_finished(tmp_path: Path) -> None:
    answer = CliRunner().invoke(command.run, ["rivals", "estimators", "--folder", str(tmp_path)])
    assert answer.exit_code == 1
    (path,) = results.newest_first(tmp_path)
    assert [each.name for each in results.read(path).benchmarks] == ["rivals"]
