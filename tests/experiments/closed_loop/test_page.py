import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.result_cases import made_up_budget, made_up_magnitude

from faintspot.experiments.closed_loop.page import loop_page, loop_warnings
from faintspot.experiments.closed_loop.verdict import NOWHERE, LoopResults
from faintspot.loop.simulation.record import MAGNITUDE_FILE

pytest.importorskip("hcipy")


@pytest.mark.slow
def test_the_page_holds_everything(tmp_path: Path) -> None:
    made_up_magnitude().save(tmp_path / MAGNITUDE_FILE)
    made_up_budget().save(tmp_path / "budget.npz")
    written = loop_page(LoopResults.load(tmp_path)).write(tmp_path / "report.html")
    assert written[0] == tmp_path / "report.html"
    assert {path.name for path in written[1:]} == {f"magnitude.{ending}" for ending in ("png", "svg", "csv")}
    page = written[0].read_text(encoding="utf-8")
    assert "limiting magnitude" in page
    assert page.count("data:image/svg+xml") == 1
    for bad in ("nan", "None", "{{"):
        assert f">{bad}" not in page
    rows = (tmp_path / "report-figures" / "magnitude.csv").read_text().splitlines()
    assert len(rows) == 1 + 4 * 5


@pytest.mark.usefixtures("undrawn_pictures")
def test_the_page_says_when_tv_gains_nothing() -> None:
    page = loop_page(LoopResults(made_up_magnitude(-0.3))).html()
    assert NOWHERE in page


@pytest.mark.usefixtures("undrawn_pictures")
def test_what_was_not_run_is_said() -> None:
    page = loop_page(LoopResults(budget=made_up_budget())).html()
    assert "Not run: “faintspot loop magnitude” does that." in page
    assert "Nothing to compare yet." in page


@pytest.mark.usefixtures("undrawn_pictures")
def test_unfinished_results_make_a_page() -> None:
    whole = made_up_magnitude()
    strehl = whole.strehl.copy()
    strehl[1, 2:] = np.nan
    strehl[3] = np.nan
    results = LoopResults(magnitude=dataclasses.replace(whole, strehl=strehl))
    assert "runs are still missing" in loop_warnings(results)[0]
    page = loop_page(results).html()
    assert ">nan" not in page
    nothing = LoopResults(magnitude=dataclasses.replace(whole, strehl=np.full_like(strehl, np.nan)))
    assert ">nan" not in loop_page(nothing).html()


def test_few_realisations_are_warned_of() -> None:
    lines = loop_warnings(LoopResults(made_up_magnitude(realisations=2)))
    assert any("fewer than 5" in line for line in lines)


def test_sections_have_different_names() -> None:
    names = [section.name for section in loop_page(LoopResults(made_up_magnitude())).sections]
    assert len(set(names)) == len(names)
