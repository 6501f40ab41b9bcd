"""The page of a run holds everything, and nothing from elsewhere."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from benchmarks import __main__ as command
from benchmarks import figures, latency, page, results, scale
from click.testing import CliRunner
from tests import benchmark_cases as cases


@pytest.fixture(scope="module")
def html() -> str:
    return page.page(cases.results())


def test_it_needs_nothing_else(html: str) -> None:
    assert not re.search(r"<script|<link|src=\"(?!data:)|url\(", html)


def test_it_shows_tables_targets_machine_and_how_it_was_measured(html: str) -> None:
    for text in ("Against &lt;others&gt;", "a note &amp; more", "&gt;= 9", "2 of 2 are met", "Linux 1"):
        assert text in html
    for text in ("<li>one way</li>", "<p>How it is measured:</p>", "0.1, 0.2, 0.3", "± 1.0 %"):
        assert text in html
    assert html.count("<img ") == 4


def test_a_missed_target_comes_first_and_a_failure_is_told() -> None:
    found = cases.results([cases.roofline_table(), cases.rivals_table(5.0)])
    found.benchmarks.append(results.Benchmark("loop", "", 0.0, "", failure="ValueError: why"))
    html = page.page(found)
    targets = html[: html.index('<section id="rivals"')]
    assert "1 of 2 are met" in targets
    assert targets.index("NumPy, all at once") < targets.index("W = 16")
    assert "loop: ValueError: why" in html


@pytest.mark.parametrize("name", list(figures.CAPTIONS))
def test_without_its_tables_a_picture_is_left_out(name: str) -> None:
    assert figures.CAPTIONS[name][0]({}) is None


def test_paragraphs_and_lists_of_a_docstring() -> None:
    found = page.paragraphs("Title\nof two lines.\n\nText\ngoes on:\n- one\n  more\n- two\n\nEnd.")
    assert [(part.text, part.items) for part in found] == [
        ("Text goes on:", []),
        ("", ["one more", "two"]),
        ("End.", []),
    ]


def test_the_page_of_stored_results_is_made_again(tmp_path: Path) -> None:
    path = results.write(cases.results([cases.rivals_table()]), tmp_path)
    assert CliRunner().invoke(command.make_page, [str(path)]).exit_code == 0
    assert path.with_suffix(".html").exists()
    path.write_text("{}")
    assert CliRunner().invoke(command.make_page, [str(path)]).exit_code == 2


def test_a_linear_cost_is_fitted_exactly() -> None:
    numbers = np.array([36.0, 100.0, 4616.0])
    call, each, deviation = scale.linear_fit(numbers, 3e-5 + 2e-6 * numbers)
    assert (call, each) == pytest.approx((3e-5, 2e-6))
    assert deviation < 1e-9


def test_the_tail_ends_where_the_number_of_frames_ends_it() -> None:
    curve = latency.tail_curve(np.arange(1.0, 2001.0))
    latencies, fractions = np.array(curve).T
    assert (np.diff(latencies) >= 0).all()
    assert (np.diff(fractions) < 0).all()
    assert fractions[-1] >= 1 / 2000
    assert latency.quantile_columns(np.arange(1.0, 2001.0))["p50"] == pytest.approx(1000.5)
