import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.result_cases import LABELS, made_up_magnitude

from faintspot.base.report.page import FigureWithData
from faintspot.experiments.closed_loop.magnitude import save_recommended
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.closed_loop.verdict import (
    NOWHERE,
    equal_methods,
    loop_page,
    loop_summary,
    loop_verdict,
    loop_warnings,
    reference_methods,
    tv_method,
)
from faintspot.loop.simulation.configuration import load_loop
from faintspot.slopes.pipeline.settings import Settings

pytest.importorskip("hcipy")


def test_no_gain_anywhere_is_said_exactly() -> None:
    lines = loop_verdict(made_up_magnitude(-0.3))
    assert lines[0].startswith(NOWHERE)
    assert "lowers it beyond its error" in lines[0]


def test_a_gain_is_said() -> None:
    lines = loop_verdict(made_up_magnitude(0.3))
    assert NOWHERE not in " ".join(lines)
    assert "beyond its error in" in lines[0]


def test_methods_are_found_by_their_names() -> None:
    result = dataclasses.replace(made_up_magnitude(), labels=tuple("abcd"))
    assert LABELS[reference_methods(result)[0]] == "brightest pixels"
    method = tv_method(result)
    assert method is not None
    assert LABELS[method] == "TV denoising"


def test_gains_are_stated_against_the_strongest_baseline() -> None:
    result = dataclasses.replace(made_up_magnitude(), names=("brightest", "tv", "window", "ml"))
    assert reference_methods(result) == [2, 0]
    lines = [line for line in loop_verdict(result) if line.startswith("Magnitudes")]
    against = [line.split(" against ")[1].split(":")[0] for line in lines]
    assert against == 3 * [result.labels[2]]


@pytest.fixture
def result() -> MagnitudeResult:
    """TV denoising is 0.01 worse than brightest pixels everywhere, give or take 0.002."""
    atmosphere = np.array([-0.1, 0.0, 0.1, 0.05, -0.05])
    brightest = np.array([0.2, 0.4, 0.6])[:, None] + atmosphere
    tv = brightest - 0.01 + 0.002 * np.array([1, -1, 0, 1, -1])
    return MagnitudeResult(
        ("brightest", "tv"),
        ("brightest pixels", "TV denoising"),
        np.array([10.0, 40.0, 160.0]),
        np.array([13.0, 11.5, 10.0]),
        np.stack([brightest, tv]),
        np.ones((2, 3, 5)),
        np.full((2, 3), ""),
        np.full((2, 3), '{"loop_gain": 0.5}'),
        "",
    )


def summary(result: MagnitudeResult, realisations: int = 5) -> str:
    few = {name: getattr(result, name)[:, :, :realisations] for name in ("strehl", "centroid_gain")}
    return loop_summary(replace(result, **few))


def test_the_summary_of_magnitudes_has_errors_and_a_verdict(result: MagnitudeResult) -> None:
    heading, brightest, *rest = summary(result).splitlines()
    assert "10 e⁻, 13.0 mag" in heading
    error = np.std([-0.1, 0.0, 0.1, 0.05, -0.05], ddof=1) / np.sqrt(5)
    words = "brightest pixels", *(f"{value:.3f} ± {error:.3f}" for value in (0.2, 0.4, 0.6))
    assert brightest.split() == " ".join(words).split()
    assert any(line.startswith("TV raises the Strehl ratio nowhere beyond its error") for line in rest)


def test_few_realisations_have_no_error_and_name_no_gain(result: MagnitudeResult) -> None:
    single = summary(result, 1)
    assert "nan" not in single
    assert "0.100 ±" not in single
    assert "limiting magnitude" not in summary(result, 2)  # not a figure of a gain whose error is not known


def test_the_simplest_of_equal_methods_is_recommended() -> None:
    """The baseline where it is as good as the best; another one where it is below beyond the error."""
    steps = np.array([-0.02, -0.01, 0.01, 0.02])
    strehl = np.array([[0.3 + steps], [0.5 + steps], [0.5 - steps], [0.7 + steps]])
    names = ("brightest", "window", "map+predicted", "map+kalman")
    made = replace(
        made_up_magnitude(),
        names=names,
        labels=names,
        photons=np.array([50.0]),
        magnitudes=np.array([10.0]),
        strehl=strehl,
        centroid_gain=np.ones((4, 1, 4)),
        settings=np.full((4, 1), ""),
        choices=np.full((4, 1), '{"loop_gain": 0.3}'),
    )
    assert equal_methods(made, 0) == [3]
    level = replace(made, strehl=np.concatenate([strehl[:3], strehl[1:2] + steps / 10]))
    assert equal_methods(level, 0) == [1, 2, 3]
    text = " ".join(loop_verdict(made))
    assert "Recommended at magnitude 10.00 (50 e-): map+kalman (loop_gain 0.3)." in text
    nothing = replace(made, strehl=np.full(strehl.shape, np.nan))
    assert equal_methods(nothing, 0) == []


def test_what_is_recommended_for_the_star_is_written(tmp_path: Path) -> None:
    loop = load_loop("canary")
    made = replace(
        made_up_magnitude(),
        names=("window",),
        labels=("window",),
        photons=np.array([0.1, 1.0]) * loop.photons,
        magnitudes=np.array([12.5, 10.0]),
        strehl=np.full((1, 2, 3), 0.4),
        centroid_gain=np.ones((1, 2, 3)),
        settings=np.full((1, 2), ""),
        choices=np.array(
            [['{"loop_gain": 0.1, "window_fwhm_px": 5.0}', '{"loop_gain": 0.3, "window_fwhm_px": 3.0}']]
        ),
    )
    beside = save_recommended(made, loop, tmp_path / "faintspot.toml")
    settings = Settings.load(tmp_path / "faintspot.toml")
    assert (settings.estimator.name, settings.window_fwhm_px) == ("window", 3.0)
    assert load_loop(beside).control.gain == 0.3
    assert load_loop(beside).photons == pytest.approx(loop.photons)


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
