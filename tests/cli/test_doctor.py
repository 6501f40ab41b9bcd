"""`faintspot doctor`: whatever is installed, it answers, and says what to do about what is missing."""

import json
import sys

import numba
import pytest
from tests.cli.cli_cases import Commands

import faintspot
from faintspot.base.extras import EXTRAS
from faintspot.cli.doctor import Finding, examine

NAMES = ["faintspot", "Python", "packages", *(f"extra {name}" for name in EXTRAS), "processor"]


def named(name: str) -> Finding:
    return next(finding for finding in examine() if finding.name == name)


def test_everything_is_looked_at_in_one_line_each() -> None:
    findings = examine()
    assert [finding.name for finding in findings] == NAMES
    for finding in findings:
        assert finding.value
        assert "\n" not in f"{finding.value}{finding.advice}"
        assert "cannot be found out" not in finding.value
    assert faintspot.__version__ in findings[0].value
    assert f"numba {numba.__version__}" in findings[2].value


def test_findings_are_text_or_json(run: Commands) -> None:
    text = run.ok("doctor").out
    assert all(f"\n{name}" in f"\n{text}" for name in NAMES)
    findings = json.loads(run.ok("doctor", "--json").out)
    assert [finding["name"] for finding in findings] == NAMES
    assert set(findings[0]) == {"name", "value", "advice"}


def test_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyshmem", None)
    assert named("extra realtime").advice == "pip install 'faintspot[realtime]'"


def test_a_broken_installation_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise OSError("two\nlines")

    monkeypatch.setattr("faintspot.slopes.kernels.compilation.target.compile_target", broken)
    assert named("processor").value == "cannot be found out (OSError: two lines)"


def test_processor_that_is_forced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAINTSPOT_SIMD_WIDTH", "4")
    found = named("processor")
    assert "4 lanes" in found.value
    assert "FAINTSPOT_SIMD_WIDTH=4" in str(found.advice)
