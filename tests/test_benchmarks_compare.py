"""What changed between two runs is told from noise; nothing is timed."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks import __main__ as command
from benchmarks import compare, measuring, results
from benchmarks.measuring import Row, Table
from click.testing import CliRunner
from tests import benchmark_cases as cases

OTHER = {**cases.MACHINE, "processor": "another"}


def one_row(value: float, spread: float, *, target: str = "", better: str = "") -> results.Results:
    row = Row("row", {"ratio": value}, target, spread={"ratio": spread}, better=better)
    return cases.results([Table("table", "Table", [row])])


@pytest.mark.parametrize(
    ("target", "better", "value", "verdict"),
    [
        (">= 9", "", 1.2, compare.BETTER),
        (">= 9", "", 0.8, compare.WORSE),
        ("at least 80", "", 0.8, compare.WORSE),
        ("<= 1", "", 1.2, compare.WORSE),
        ("own <= 0.15", "", 0.8, compare.BETTER),
        ("", "higher", 1.2, compare.BETTER),
        ("", "lower", 1.2, compare.WORSE),
        (">= 9", "", 1.05, compare.WITHIN_NOISE),
        ("<= 1", "", 0.95, compare.WITHIN_NOISE),
    ],
)
def test_the_direction_decides(target: str, better: str, value: float, verdict: str) -> None:
    runs = [one_row(each, 0.001, target=target, better=better) for each in (1.0, value)]
    (change,) = compare.changes(*runs)
    assert change.verdict == verdict
    assert change.change == pytest.approx(np.log(value))


def test_the_spread_of_either_run_widens_the_noise() -> None:
    sharp, blurred = one_row(10.0, 0.001, better="higher"), one_row(8.0, 0.1, better="higher")
    (change,) = compare.changes(sharp, blurred)
    assert change.verdict == compare.WITHIN_NOISE
    assert change.noise == pytest.approx(3 * np.sqrt(0.001**2 + 0.1**2 + 2 * 0.02**2))


def invoke(folder: Path, *arguments: str) -> tuple[int, str]:
    answer = CliRunner().invoke(command.compare_runs, [*arguments, "--folder", str(folder)])
    return answer.exit_code, answer.output


def store(folder: Path, day: int, ratio: float, machine: dict[str, str] = cases.MACHINE) -> str:
    found = cases.results([cases.rivals_table(ratio)], started=f"2026-01-0{day}T00:00:00", machine=machine)
    return str(results.write(found, folder))


@pytest.mark.parametrize(("ratio", "status"), [(20.0, 0), (30.0, 0), (15.0, 1)])
def test_the_exit_status_says_whether_something_got_worse(tmp_path: Path, ratio: float, status: int) -> None:
    store(tmp_path, 1, 20.0)
    store(tmp_path, 2, ratio)
    code, output = invoke(tmp_path)
    assert code == status
    assert "within noise" in output


def test_different_machines_are_refused_in_one_line(tmp_path: Path) -> None:
    old, new = store(tmp_path, 1, 20.0), store(tmp_path, 2, 20.0, OTHER)
    code, output = invoke(tmp_path, old, new)
    assert code == 2
    assert output.count("\n") == 1
    assert "processor: one and another" in output
    assert invoke(tmp_path)[0] == 2
    assert invoke(tmp_path, old, new, "--anyway")[0] == 0
    assert invoke(tmp_path, "--anyway")[0] == 0


def test_spread_is_the_standard_error() -> None:
    rng = np.random.default_rng(1)
    times = {"a": np.exp(rng.normal(0.0, 0.1, 4000)), "b": np.ones(4000)}
    # The median's standard error is 1.25 times the mean's; ten parts tell it to within a factor of 2.
    found = measuring.ratio(times, "a", "b").spread["median ratio"]
    assert found == pytest.approx(1.25 * 0.1 / np.sqrt(4000), rel=0.75)
