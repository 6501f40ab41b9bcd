import dataclasses

import numpy as np
import pytest
from tests.experiments.result_cases import made_up_magnitude

from faintspot.base.report.page import FigureWithData
from faintspot.experiments.closed_loop.page import loop_page, loop_warnings
from faintspot.experiments.closed_loop.verdict import NOWHERE

pytest.importorskip("hcipy")


@pytest.mark.usefixtures("undrawn_pictures")
def test_the_page_holds_everything() -> None:
    page = loop_page(made_up_magnitude())
    text = page.html()
    assert "limiting magnitude" in text
    for bad in ("nan", "None", "{{"):
        assert f">{bad}" not in text
    parts = [part for section in page.sections for part in section.parts]
    (figure,) = (part for part in parts if isinstance(part, FigureWithData))
    assert figure.csv.count("\n") == 1 + (4 + 3) * 5


@pytest.mark.usefixtures("undrawn_pictures")
def test_the_page_says_when_tv_gains_nothing() -> None:
    page = loop_page(made_up_magnitude(-0.3)).html()
    assert NOWHERE in page


@pytest.mark.usefixtures("undrawn_pictures")
def test_unfinished_results_make_a_page() -> None:
    whole = made_up_magnitude()
    strehl = whole.strehl.copy()
    strehl[1, 2:] = np.nan
    strehl[3] = np.nan
    results = dataclasses.replace(whole, strehl=strehl)
    assert "runs are still missing" in loop_warnings(results)[0]
    page = loop_page(results).html()
    assert ">nan" not in page
    nothing = dataclasses.replace(whole, strehl=np.full_like(strehl, np.nan))
    assert ">nan" not in loop_page(nothing).html()


def test_few_realisations_are_warned_of() -> None:
    lines = loop_warnings(made_up_magnitude(realisations=2))
    assert any("fewer than 5" in line for line in lines)


def test_sections_have_different_names() -> None:
    names = [section.name for section in loop_page(made_up_magnitude()).sections]
    assert len(set(names)) == len(names)
