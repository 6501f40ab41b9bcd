"""faintspot demo: it runs, again too, and what it leaves is what the other commands would make."""

from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import Commands

from faintspot import SlopePipeline
from faintspot.cli.demo import comparison_table
from faintspot.experiments import demonstration
from faintspot.experiments.demonstration import FLUXES_E, Comparison, Scored
from faintspot.io import read_slopes
from faintspot.slopes.pipeline.settings import Settings

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

FILES = {"frames.npy", "truth.npy", "tv.toml", "tv.npz", "no-tv.toml", "no-tv.npz", "report.html"}


@pytest.mark.slow
def test_demo_writes_files_and_repeats(folder: Path, run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "BEST_KEPT", (8, 16))  # fewer candidates: others test what is chosen
    monkeypatch.setattr(demonstration, "STRENGTH_FACTORS", (1.0,))
    first = run.ok("demo", "--frames", 20, "-o", "new/demo", "--seed", 7)
    made = folder / "new" / "demo"
    assert {path.name for path in made.iterdir()} == FILES
    for text in ("best k", "fixed k = 40", "R without", "R with TV", "480", "of flux", "report.html"):
        assert text in first.out
    assert max(map(len, first.out.splitlines())) <= 100
    assert "20/20" in first.err
    frames, truth = np.load(made / "frames.npy"), np.load(made / "truth.npy")
    assert frames.shape == (20, 112, 112)
    assert truth.shape == (20, 36, 2)
    for method in ("tv", "no-tv"):
        stored = read_slopes(made / f"{method}.npz").variables
        np.testing.assert_array_equal(stored["x"], SlopePipeline.from_file(made / f"{method}.toml")(frames).x)
    assert "<img" in (made / "report.html").read_text(encoding="utf-8")
    # The page was made once, and takes longest: the second one only has to replace it.
    monkeypatch.setattr("faintspot.base.report.page.Report.html", lambda report: "second")
    second = run.ok("demo", "--frames", 20, "-o", "new/demo", "--seed", 7)
    assert second.out == first.out
    assert {path.name for path in made.iterdir()} == FILES
    np.testing.assert_array_equal(np.load(made / "frames.npy"), frames)
    assert (made / "report.html").read_text(encoding="utf-8") == "second"


def test_a_gain_that_is_not_reached_is_said_in_words() -> None:
    def methods(error: float) -> list[Scored]:
        return [Scored(Settings("tv", noise_std=1.0), np.full(20, error / flux)) for flux in FLUXES_E]

    table = comparison_table(Comparison("best k", methods(1.0), methods(1e3)), np.random.default_rng(1))
    assert "nan" not in str(table.caption)
    assert "no flux" in str(table.caption)
