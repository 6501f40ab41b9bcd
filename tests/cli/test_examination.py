"""`faintspot doctor`: whatever the machine, it answers, and says what to do about what is missing."""

from __future__ import annotations

import json
import os
import sys
from collections import namedtuple
from pathlib import Path

import numba
import pytest
from tests.cli.cli_cases import Commands

import faintspot
from faintspot.base.extras import EXTRAS
from faintspot.cli import examination as doctor
from faintspot.cli.examination import Finding, examine, file_system

NAMES = [
    "faintspot",
    "Python",
    "packages",
    *(f"extra {name}" for name in EXTRAS),
    "processor",
    "cache",
    "threads",
    "shared memory",
    "real time",
]


def named(name: str) -> Finding:
    return next(finding for finding in examine() if finding.name == name)


@pytest.fixture(autouse=True)
def _without_a_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trying real time takes a second: only where it is asked for."""
    if "real_time" not in request.node.name:
        monkeypatch.setattr(doctor, "_real_time", lambda: Finding("real time", "not tried"))


@pytest.mark.portable
def test_everything_is_looked_at_in_one_line_each() -> None:
    findings = examine()
    assert [finding.name for finding in findings] == NAMES
    for finding in findings:
        assert finding.value
        assert "\n" not in f"{finding.value}{finding.advice}"
        assert "cannot be found out" not in finding.value
    assert faintspot.__version__ in findings[0].value
    assert f"numba {numba.__version__}" in findings[2].value


@pytest.mark.portable
def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    run = Commands(capsys)
    text = run.ok("doctor").out
    assert all(f"\n{name}" in f"\n{text}" for name in NAMES)
    findings = json.loads(run.ok("doctor", "--json").out)
    assert [finding["name"] for finding in findings] == NAMES
    assert set(findings[0]) == {"name", "value", "advice"}


def test_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyshmem", None)
    assert named("extra realtime").advice == "pip install 'faintspot[realtime]'"


def test_a_check_that_fails_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> Finding:
        raise OSError("two\nlines")

    monkeypatch.setattr(doctor, "_cache", broken)
    assert named("cache") == Finding("cache", "cannot be found out (OSError: two lines)", "report this line")


def test_a_cache_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "faintspot.slopes.kernels.compilation.cached.cache_folder", lambda: tmp_path / "absent"
    )
    found = named("cache")
    assert "cannot be written" in found.value
    assert "NUMBA_CACHE_DIR" in str(found.advice)
    monkeypatch.setattr("faintspot.slopes.kernels.compilation.cached.cache_folder", lambda: None)
    assert "NUMBA_CACHE_DIR" in str(named("cache").advice)


def test_a_cache_on_a_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("faintspot.slopes.kernels.compilation.cached.cache_folder", lambda: tmp_path)
    monkeypatch.setattr(doctor, "file_system", lambda path: "nfs4")
    assert "local disk" in str(named("cache").advice)
    monkeypatch.setattr(doctor, "file_system", lambda path: "ext4")
    assert named("cache").advice is None


def test_file_system(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    lines = ["/dev/sda / ext4 rw 0 0", "server:/home /home nfs4 rw 0 0", "none /home/a\\040b tmpfs rw 0 0"]
    mounts.write_text("\n".join(lines))
    assert file_system(Path("/usr/lib"), mounts) == "ext4"
    assert file_system(Path("/home/someone/.cache"), mounts) == "nfs4"
    assert file_system(Path("/home/a b/c"), mounts) == "tmpfs"
    assert file_system(Path("/usr"), tmp_path / "absent") == "unknown"


def test_processor_that_is_forced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAINTSPOT_SIMD_WIDTH", "4")
    found = named("processor")
    assert "4 lanes" in found.value
    assert "FAINTSPOT_SIMD_WIDTH=4" in str(found.advice)


def test_shared_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(doctor, "SHARED_MEMORY", tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage(0, 0, 64e6))
    assert "--shm-size" in str(named("shared memory").advice)
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage(0, 0, 4e9))
    assert named("shared memory").advice is None
    monkeypatch.setattr(doctor, "SHARED_MEMORY", tmp_path / "absent")
    assert "Linux" in str(named("shared memory").advice)


@pytest.mark.portable
@pytest.mark.skipif(sys.platform != "linux", reason="scheduling of Linux")
def test_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    before = os.sched_getscheduler(0)
    found = named("real time")
    assert "rtprio" in found.value
    assert ("not permitted" in found.value) == (found.advice is not None)
    assert os.sched_getscheduler(0) == before
    monkeypatch.setattr(doctor, "_TRY_REAL_TIME", "print('locked memory: Cannot allocate memory')")
    refused = named("real time")
    assert "not permitted: locked memory" in refused.value
    assert "memlock unlimited" in str(refused.advice)


def test_real_time_beyond_linux(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    assert "Linux" in str(named("real time").advice)
