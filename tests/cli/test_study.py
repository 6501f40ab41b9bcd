"""faintspot study: runs, goes on after kill -9, and says in one line what is wrong."""

import subprocess
import time
from pathlib import Path

import pytest
from tests.cli.cli_cases import Commands, command_line

from faintspot.experiments import StudySpecification, Sweep, WorkerPool, open_study, run
from faintspot.experiments.study import specification as estimators

pytest.importorskip("zarr")
pytest.importorskip("xarray")

pytestmark = pytest.mark.slow

SMALL = """
name = "small"
realisations = 200

[sweeps.flux]
flux_e = [30, 100]
"""
SLOW = """
name = "slow"
realisations = 1500
estimators = ["brightest", "tv"]

[sweeps.flux]
flux_e = { from = 10, to = 1000, points = 12, spacing = "log" }
"""


def test_estimators(folder: Path, run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = Sweep("a", flux_e=[50, 200], pixels=8)
    small = StudySpecification(
        "estimators", [sweep], realisations=100, estimators=["brightest", "ml"], fixed_k=[]
    )
    monkeypatch.setattr(estimators, "estimators_study", lambda quick: small)
    out = run.ok("study", "estimators", "--quick", "--workers", 0).out
    assert "estimators-quick.html: open it in a browser" in out
    assert "What was found" in Path("estimators-quick.html").read_text(encoding="utf-8")


def test_run(folder: Path, run: Commands) -> None:
    Path("my-study.toml").write_text(SMALL)
    first = run.ok("study", "my-study.toml", "--workers", 0)
    assert "2 of them in this run" in first.out
    assert "faintspot report my-study.zarr" in first.out
    assert "400/400" in first.err
    assert open_study("my-study.zarr")["done"].all()
    again = run.ok("study", "my-study.toml", "-o", "my-study.zarr", "--workers", 0)
    assert "complete already" in again.out
    Path("my-study.toml").write_text(SMALL.replace("200", "300"))
    refused = run.refused("study", "my-study.toml", "--workers", 0, naming=("another study", "--overwrite"))
    assert "'small'" in refused.error
    run.ok("study", "my-study.toml", "--workers", 0, "--overwrite")
    assert open_study("my-study.zarr").attrs["n"] == 300


def test_bad_input(folder: Path, run: Commands) -> None:
    run.refused("study", "nothing.toml", naming=("nothing.toml", "no such file"))
    Path("bad.toml").write_text(SMALL + "read_noise_e = -1\n")
    run.refused("study", "bad.toml", naming=("bad.toml", "read_noise_e = -1"))
    Path("bad.toml").write_text(SMALL + "sizes = 1\n")
    run.refused("study", "bad.toml", naming=("did you mean size",))
    run.refused("study", "paper", "--figure", "fig99", naming=("fig99",))
    run.refused("study", "paper", "--workers", -1, naming=("--workers",))
    assert not list(folder.glob("*.zarr"))


def test_killed_and_started_again(folder: Path, run: Commands) -> None:
    Path("slow.toml").write_text(SLOW)
    store = folder / "slow.zarr"
    process = command_line("study", "slow.toml", "--workers", 0, cwd=folder)
    try:
        end = time.monotonic() + 60
        while len(list(store.glob("done/c/*"))) < 2 and process.poll() is None and time.monotonic() < end:
            time.sleep(0.002)
        process.kill()
        process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    assert 2 <= int(open_study(store)["done"].sum()) < 12
    run.ok("study", "slow.toml", "--workers", 0)
    whole = folder / "whole.zarr"
    uninterrupted(whole)
    found, expected = (
        {str(p.relative_to(s)): p.read_bytes() for p in s.rglob("*") if p.is_file()} for s in (store, whole)
    )
    assert found == expected


def uninterrupted(path: Path) -> None:
    run(StudySpecification.from_text(SLOW), path, pool=WorkerPool(0))


def test_report_of_a_study(folder: Path, run: Commands) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    Path("my-study.toml").write_text(SMALL)
    run.ok("study", "my-study.toml", "--workers", 0)
    assert "my-study.html" in run.ok("report", "my-study.zarr").out
    page = (folder / "my-study.html").read_text(encoding="utf-8")
    assert "small" in page
    assert "2 of 2" in page
    run.refused("report", "my-study.zarr", "my-study.zarr", naming=("my-study.zarr",))
