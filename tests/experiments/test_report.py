"""The report page of a study: complete, self-contained, honest about what is missing."""

import re
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from tests.experiments.study_cases import dataset, power_law
from tests.refusals import refused

from faintspot.experiments.report import report_of_study, study_report
from faintspot.experiments.study.specification import StudySpecification, paper_study
from faintspot.experiments.study.sweep import Sweep

pytestmark = pytest.mark.usefixtures("undrawn_pictures")


def of(specification: StudySpecification, **options: Any) -> Any:
    def gain(cell: Any, method: str, mode: str) -> float:
        return 1.4 if method == "tv" else 1.0

    data = dataset([asdict(cell) for cell in specification.cells()], power_law(gain), **options)
    data.attrs["specification"] = specification.to_text()
    return data


class TestPage:
    @pytest.mark.slow
    def test_is_complete_and_in_order(self) -> None:
        html = study_report(of(paper_study(quick=True))).html()
        sections = re.findall(r'<section id="([^"]+)"', html)
        assert sections[:4] == ["paper", "guidance", "baselines", "gains"]
        assert sections[4:11] == ["fig1", "fig2", "fig3", "fig4", "fig5", "fig6", "fig7"]
        assert sections[-1] == "specification"
        assert 'download="verdicts.csv"' in html
        assert html.count('<tr><th scope="row">') >= 8
        assert "not finished" not in html
        parser = HTMLParser()
        parser.feed(html)
        parser.close()

    def test_of_an_unfinished_study_says_so(self) -> None:
        data = of(paper_study(quick=True), unfinished=tuple(range(1, 40)))
        html = study_report(data).html()
        assert "This study is not finished" in html
        assert "39 cells are still missing" in html
        assert "not measured" in html

    def test_of_another_study_has_its_sweeps(self) -> None:
        sweep = Sweep("emccd", flux_e=(20, 60, 200), em_gain=(1, 300), background_e=2)
        html = study_report(of(StudySpecification("my <study>", [sweep]))).html()
        assert "<h2>emccd</h2>" in html
        assert 'id="fig1"' not in html
        assert "my &lt;study&gt;" in html

    def test_of_methods_without_tv_has_no_verdict(self) -> None:
        data = of(paper_study(quick=True, figures=["fig3"]))
        html = study_report(
            data.sel(estimator=["brightest", "smoothed"], estimator2=["brightest", "smoothed"])
        ).html()
        assert "Nothing to judge" in html


def test_study_without_a_finished_cell_is_refused(tmp_path: Path) -> None:
    data = of(paper_study(quick=True, figures=["fig3"]))
    data["done"][:] = False
    with refused("8 cells"):
        study_report(data)
    with refused("nothing.zarr"):
        report_of_study(tmp_path / "nothing.zarr")
