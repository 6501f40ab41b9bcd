"""The built-in study of the estimators: its cells, its figures, its tables."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from tests.experiments.study_cases import cells, dataset, power_law
from tests.shared_data import shared_file

from faintspot.base.report import plots
from faintspot.experiments.report import (
    compares_estimators,
    estimator_figures,
    study_report,
)
from faintspot.experiments.study.specification import estimators_study
from faintspot.experiments.study.sweep import Cell

METHODS = ("brightest", "tv", "ml", "map", "weighted")


def error(cell: dict[str, Any], method: str, mode: str) -> float:
    return power_law(lambda c, a, m: 1.5 if a in ("ml", "map") else 1.0)(cell, method, mode)


def study(**options: Any) -> Any:
    every = [
        *cells(),
        *cells(read_noise_e=3.0),
        *cells(elongation=3.0),
        *(row for d in (0.5, 1.0, 3.0) for row in cells(d_over_r0=d, fluxes=(50.0, 200.0))),
    ]
    return dataset(every, error, methods=METHODS, **options)


def test_full_study_has_the_reference_cases() -> None:
    text = json.loads(shared_file("reference/slope_error_cases.json").read_text())
    wanted = set()
    for case in text.get("cases", text).values():
        given = case["params"]
        profile = {"sinc2": "diffraction", "gauss": "gaussian"}[given["psf"]]
        camera = (given["elong"], given["n"], given["rng_px"], 0.0, 1.0)
        wanted.add(Cell(float(given["flux"]), given["rn"], profile, given["size"], *camera))
    assert len(wanted) == 24
    assert wanted <= set(estimators_study().cells())


def test_cost_is_bounded() -> None:
    full, quick = estimators_study().cells(), estimators_study(quick=True).cells()
    assert len(full) <= 120
    assert sum(cell.d_over_r0 > 0 for cell in full) <= 40
    assert len(quick) <= 15
    assert {cell.read_noise_e for cell in full} >= {0.1, 1, 3, 16}


def test_estimator_figures_have_their_panels() -> None:
    made = {figure.name: figure for figure in estimator_figures(study())}
    assert set(made) == {
        "estimators-diffraction",
        "estimators-diffraction-elongation3",
        "speckled-diffraction",
    }
    first = made["estimators-diffraction"].figure
    assert [axes.get_title() for axes in first.axes] == 3 * ["0.1 e- read noise"] + 3 * ["3 e- read noise"]
    assert len(first.axes[0].containers) == len(METHODS) + 1  # and the bound
    turbulence = made["speckled-diffraction"].figure
    assert [axes.get_title() for axes in turbulence.axes] == [
        "0.1 e- read noise, 50 e- signal",
        "0.1 e- read noise, 200 e- signal",
    ]
    rings = [line for line in turbulence.axes[0].lines if line.get_markersize() == 15]
    np.testing.assert_allclose(np.asarray(rings[0].get_xdata(), float), [0.5, 1, 3])
    assert all(figure.caption and figure.csv for figure in made.values())
    # Unfinished studies are drawn as far as they are; other studies do not compare estimators.
    assert list(estimator_figures(study(unfinished=range(21)))) == []
    names = [figure.name for figure in estimator_figures(study(unfinished=range(3, 21)))]
    assert names == ["estimators-diffraction"]
    assert compares_estimators(study())
    assert not compares_estimators(dataset(cells(), error))


def test_estimators_report_has_its_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "DOTS_PER_INCH", 20)
    monkeypatch.setattr(plots, "svg", lambda figure: b"")  # another drawing, as slow
    specification = estimators_study(quick=True)
    quick = [asdict(cell) for cell in specification.cells()]
    few = [row for row in quick if row["d_over_r0"] > 0 or row["read_noise_e"] == 3]
    data = dataset(few, error, methods=METHODS)
    data.attrs["specification"] = specification.to_text()
    html = study_report(data).html()
    assert 'id="paper"' not in html
    assert html.count("<figcaption>") == 2
