"""faintspot study: runs, goes on after kill -9, and says in one line what is wrong."""

import json
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from tests.cli.cli_cases import STUDY, Commands, command_line
from tests.experiments.experiment_cases import SEARCH, small
from tests.experiments.result_cases import made_up_magnitude
from tests.shared_data import skip_without

from faintspot.cli import study as command
from faintspot.experiments import StudySpecification, Sweep, WorkerPool, open_study
from faintspot.experiments import run as run_study
from faintspot.experiments.closed_loop import magnitude
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.night import page, protocol
from faintspot.experiments.night.protocol import Night, NightPlan
from faintspot.experiments.study import specification as estimators
from faintspot.loop.control.configuration import load_control
from faintspot.loop.simulation.configuration import LoopConfiguration, load_loop, shipped_loops
from faintspot.slopes.pipeline import configuration

pytest.importorskip("zarr")
pytest.importorskip("xarray")
pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

pytestmark = pytest.mark.slow

SLOW = """
name = "slow"
realisations = 1000
estimators = ["brightest", "tv"]

[sweeps.flux]
flux_e = { from = 10, to = 1000, points = 6, spacing = "log" }
"""


def test_estimators_study_has_a_page(folder: Path, run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = Sweep("a", flux_e=[50, 200], pixels=8)
    small = StudySpecification(
        "estimators", [sweep], realisations=100, estimators=["brightest", "ml"], fixed_k=[]
    )
    monkeypatch.setattr(estimators, "estimators_study", lambda quick: small)
    out = run.ok("study", "estimators", "--quick", "--workers", 0).out
    assert "estimators-quick.html: open it in a browser" in out
    assert '<section id="baselines"' in Path("estimators-quick.html").read_text(encoding="utf-8")


def test_study_is_stored_resumed_and_replaced(folder: Path, run: Commands) -> None:
    Path("my-study.toml").write_text(STUDY)
    first = run.ok("study", "my-study.toml", "--workers", 0)
    assert "2 of them in this run" in first.out
    assert "faintspot report my-study.zarr" in first.out
    assert "400/400" in first.err
    assert open_study("my-study.zarr")["done"].all()
    again = run.ok("study", "my-study.toml", "-o", "my-study.zarr", "--workers", 0)
    assert "complete already" in again.out
    assert "my-study.html" in run.ok("report", "my-study.zarr").out
    page = (folder / "my-study.html").read_text(encoding="utf-8")
    assert "small" in page
    assert "2 of 2" in page
    run.refused("report", "my-study.zarr", "my-study.zarr", naming=("my-study.zarr",))
    Path("my-study.toml").write_text(STUDY.replace("200", "300"))
    run.refused("study", "my-study.toml", "--workers", 0, naming=("'small'", "--overwrite"))
    run.ok("study", "my-study.toml", "--workers", 0, "--overwrite")
    assert open_study("my-study.zarr").attrs["n"] == 300


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
    assert 2 <= int(open_study(store)["done"].sum()) < 6
    run.ok("study", "slow.toml", "--workers", 0)
    whole = folder / "whole.zarr"
    run_study(StudySpecification.from_text(SLOW), whole, pool=WorkerPool(0))
    found, expected = (
        {str(p.relative_to(s)): p.read_bytes() for p in s.rglob("*") if p.is_file()} for s in (store, whole)
    )
    assert found == expected


skip_without("hcipy")


@pytest.fixture(autouse=True)
def _small_experiments(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(magnitude, "QUICK", SEARCH)
    monkeypatch.chdir(tmp_path)
    faint = small().replace("camera", em_gain=100.0).replace("run", photons_per_subaperture=(40.0, 400.0))
    Path("small.toml").write_text(faint.to_text(), encoding="utf-8")


def test_list_and_show(run: Commands) -> None:
    listed = run("loop", "show").out.splitlines()
    assert [line.split()[0] for line in listed] == shipped_loops()
    shown = run("loop", "show", "canary").out
    assert LoopConfiguration.from_text(shown) == load_loop("canary")


def test_magnitude_writes_a_page_that_report_makes_again(run: Commands) -> None:
    given = ("--quick", "--workers", 0, "--methods", "brightest", "--flux-e", "400", "-o", "here")
    result = run.ok("loop", "magnitude", "small.toml", *given)
    assert result.out.splitlines()[1].startswith("brightest pixels")
    assert result.out.splitlines()[-1] == "here/report.html: open it in a browser"
    assert "brightest pixels" in Path("here/report.html").read_text(encoding="utf-8")
    again = run("report", "here", "-o", "page.html")
    assert again.out == "page.html: open it in a browser\n"
    assert Path("page.html").is_file()


def test_night_says_its_verdict_and_repeats_nothing(run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    short = NightPlan(30, 10, 0, (2, 2), (1.0, 0.75), (2, 2), keep_brightest=12)
    monkeypatch.setattr(protocol, "QUICK_PLAN", short)
    arguments = "loop", "night", "small.toml", "--quick", "--workers", 0
    result = run.ok(*arguments, "--methods", "none,tv,smoothed", "--strengths", "0.7,1.5")
    lines = result.out.splitlines()
    assert lines[0].startswith("TV raises the mean Strehl ratio")
    assert lines[-1] == "small-night-quick/night.html: open it in a browser"
    assert any(line.startswith("Gaussian smoothing") for line in lines)
    assert Night.load("small-night-quick/night.npz").labels[1:3] == ("TV 0.7 e-", "TV 1.5 e-")
    assert json.loads(Path("small-night-quick/night.json").read_text(encoding="utf-8"))["verdicts"]
    again = run(*arguments, "--methods", "none,tv,smoothed", "--strengths", "0.7,1.5")
    assert again.out == result.out  # nothing was done again
    assert "--overwrite" in run(*arguments, "--strengths", "0.7").err


def test_options_of_a_night_are_passed_on(run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: dict[str, Any] = {}

    def simulate(loop: LoopConfiguration, folder: Path, **options: Any) -> None:
        taken.update(options, loop=loop, folder=folder)

    monkeypatch.setattr(command, "simulate_night", simulate)
    monkeypatch.setattr(page, "night_summary_text", lambda night: "")
    given = ("--strengths", "0.4,0.8", "--overwrite")
    run.ok("loop", "night", "small.toml", "--workers", 3, "--methods", "tv,ml", "-o", "here", *given)
    plan = NightPlan(methods=("tv", "ml"), listed_strengths=(0.4, 0.8))
    assert taken == {
        "loop": load_loop("small.toml"), "folder": Path("here"), "plan": plan, "quick": False,
        "overwrite": True, "workers": 3, "scheduler": None,
    }  # fmt: skip


def test_magnitude_recommends_for_the_configuration(run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[Any] = []
    saved: list[Any] = []

    def measure(*what: Any, pool: Any, **options: Any) -> MagnitudeResult:
        measured.append((what, options))
        return made_up_magnitude()

    monkeypatch.setattr(magnitude, "run_magnitude", measure)
    monkeypatch.setattr(magnitude, "save_recommended", lambda *what: saved.append(what[1:]))
    Path("here").mkdir()
    given = ("--methods", "tv,ml", "--flux-e", "20,50", "--write-config", "best.toml", "--workers", 2)
    run.ok("loop", "magnitude", "small.toml", "-o", "here", *given)
    loop = load_loop("small.toml")
    assert measured == [((loop, "here", ("tv", "ml"), (20.0, 50.0)), {"quick": False, "overwrite": False})]
    assert saved == [(loop, "best.toml")]


def test_engine_files_close_the_loop(run: Commands) -> None:
    """What `loop magnitude` recommends stays, and an engine has all that it needs."""
    Path("bench").mkdir()
    Path("bench/faintspot.toml").write_text('[estimator]\nname = "centroid"\n', encoding="utf-8")
    result = run("loop", "engine", "small.toml", "-o", "bench", "--frame-rate-hz", 100)
    assert result.out.endswith("next: faintspot realtime run --config bench/faintspot.toml --close-loop\n")
    settings = configuration.Configuration("bench/faintspot.toml").settings
    control = load_control("bench/faintspot.toml")
    assert settings.estimator.name == "centroid"
    assert control is not None
    assert control.options.gain == load_loop("small.toml").control.gain
    assert control.reference is not None
