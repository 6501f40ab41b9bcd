from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.result_cases import made_up_magnitude, result_of
from tests.shared_data import skip_without

from faintspot.base.report.page import FigureWithData
from faintspot.experiments.closed_loop.magnitude import save_recommended
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.closed_loop.verdict import (
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

skip_without("hcipy")

NOWHERE = "TV raises the Strehl ratio nowhere beyond its error"


def test_gains_and_losses_are_said_exactly() -> None:
    worse, better = (loop_verdict(made_up_magnitude(gain)) for gain in (-0.3, 0.3))
    assert worse[0].startswith(NOWHERE)
    assert "lowers it beyond its error" in worse[0]
    assert NOWHERE not in " ".join(better)
    assert "beyond its error in" in better[0]


def test_gains_are_stated_against_the_strongest_baseline() -> None:
    made = made_up_magnitude()
    assert (reference_methods(made), tv_method(made)) == ([0], 1)
    result = replace(made, names=("brightest", "tv", "window", "ml"))
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
    labels = "brightest pixels", "TV denoising"
    photons = np.array([10.0, 40.0, 160.0])
    return result_of(
        ("brightest", "tv"), photons, np.stack([brightest, tv]), labels=labels, magnitudes=[13.0, 11.5, 10.0]
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
    assert any("fewer than 5" in line for line in loop_warnings(made_up_magnitude(realisations=2)))


def test_the_simplest_of_equal_methods_is_recommended() -> None:
    """The baseline where it is as good as the best; another one where it is below beyond the error."""
    steps = np.array([-0.02, -0.01, 0.01, 0.02])
    strehl = np.array([[0.3 + steps], [0.5 + steps], [0.5 - steps], [0.7 + steps]])
    names = ("brightest", "window", "map+predicted", "map+kalman")
    made = result_of(names, [100.0], strehl)
    assert equal_methods(made, 0) == [3]
    level = replace(made, strehl=np.concatenate([strehl[:3], strehl[1:2] + steps / 10]))
    assert equal_methods(level, 0) == [1, 2, 3]
    text = " ".join(loop_verdict(made))
    assert "Recommended at magnitude 10.00 (100 e-): map+kalman (loop_gain 0.5)." in text
    nothing = replace(made, strehl=np.full(strehl.shape, np.nan))
    assert equal_methods(nothing, 0) == []


def test_what_is_recommended_for_the_star_is_written(tmp_path: Path) -> None:
    loop = load_loop("canary")
    choices = '{"loop_gain": 0.1, "window_fwhm_px": 5.0}', '{"loop_gain": 0.3, "window_fwhm_px": 3.0}'
    photons, strehl = np.array([0.1, 1.0]) * loop.photons, np.full((1, 2, 3), 0.4)
    made = result_of(("window",), photons, strehl, choices=np.array([choices]))
    beside = save_recommended(made, loop, tmp_path / "faintspot.toml")
    settings = Settings.load(tmp_path / "faintspot.toml")
    assert (settings.estimator.name, settings.window_fwhm_px) == ("window", 3.0)
    assert load_loop(beside).control.gain == 0.3
    assert load_loop(beside).photons == pytest.approx(loop.photons)


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
    names = [section.name for section in page.sections]
    assert len(set(names)) == len(names)
    assert NOWHERE in loop_page(made_up_magnitude(-0.3)).html()


@pytest.mark.usefixtures("undrawn_pictures")
def test_unfinished_results_make_a_page() -> None:
    results = made_up_magnitude()
    results.strehl[1, 2:] = results.strehl[3] = np.nan
    assert "runs are still missing" in loop_warnings(results)[0]
    for unfinished in (results, replace(results, strehl=np.full_like(results.strehl, np.nan))):
        assert ">nan" not in loop_page(unfinished).html()
