import json
from pathlib import Path
from typing import Any

import pytest
from tests.cli.cli_cases import Commands
from tests.experiments.experiment_cases import SEARCH, small
from tests.experiments.result_cases import made_up_magnitude

from faintspot.cli import study as command
from faintspot.experiments.closed_loop import magnitude
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.night import page, protocol
from faintspot.experiments.night.protocol import NightPlan, load_night
from faintspot.loop.control.configuration import load_control
from faintspot.loop.simulation.configuration import LoopConfiguration, load_loop, shipped_loops
from faintspot.slopes.pipeline import configuration

pytest.importorskip("hcipy")
pytest.importorskip("matplotlib")

pytestmark = pytest.mark.slow


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
    result = run(
        "loop", "magnitude", "small.toml", "--quick", "--workers", 0, "--methods", "brightest", "-o", "here"
    )
    assert result.code == 0, result.err
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
    result = run(*arguments, "--methods", "none,tv,smoothed", "--strengths", "0.7,1.5")
    assert result.code == 0, result.err
    lines = result.out.splitlines()
    assert lines[0].startswith("TV raises the mean Strehl ratio")
    assert lines[-1] == "small-night-quick/night.html: open it in a browser"
    assert any(line.startswith("Gaussian smoothing") for line in lines)
    assert load_night("small-night-quick/night.zarr").labels[1:3] == ("TV 0.7 e-", "TV 1.5 e-")
    assert json.loads(Path("small-night-quick/night.json").read_text(encoding="utf-8"))["verdicts"]
    again = run(*arguments, "--methods", "none,tv,smoothed", "--strengths", "0.7,1.5")
    assert again.out == result.out  # nothing was done again
    other = run(*arguments, "--strengths", "0.7")
    assert other.code != 0
    assert "--overwrite" in other.err
    for option, words in (("--strengths", "expected numbers"), ("--methods", "two or more")):
        refused = run(*arguments, option, "x")
        assert refused.code != 0
        assert words in refused.err


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


def test_what_magnitude_recommends_is_for_the_configuration(
    run: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["magnitude", "nowhere.toml"], "nowhere.toml: no such file; none of the shipped configurations"),
        (["show", "nowhere"], "nowhere: no such file"),
        (["engine", "small.toml", "--frame-rate-hz", "0"], "frame_rate_hz"),
        (["magnitude", "small.toml", "--flux-e", "1,x"], "--flux-e 1,x: expected numbers with commas"),
        (["magnitude", "small.toml", "--flux-e", "-1"], "photons"),
        (["magnitude", "small.toml", "-o", "no/where"], "the folder no does not exist"),
    ],
)
def test_errors_are_one_line(run: Commands, arguments: list[str], message: str) -> None:
    result = run("loop", *arguments)
    assert result.code == 2
    assert message in result.error
