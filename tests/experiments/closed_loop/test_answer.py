import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.loop_answer_cases import (
    BRIGHT,
    MIDDLE,
    PHOTONS,
    SHIFTS,
    configuration,
    made_up,
    strehl_of,
)

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop import text as loop_text
from faintspot.experiments.closed_loop.answer import LoopAnswer
from faintspot.experiments.closed_loop.question import MODEL_ERROR, sky_coverage
from faintspot.experiments.planner.figures import loop_figure
from faintspot.loop.simulation.configuration.configuration import load_loop
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings

PAIR = ("brightest", "window")


def magnitudes() -> np.ndarray:
    return configuration().photometry.magnitude(PHOTONS)


def test_the_star_is_one_of_those_measured() -> None:
    answer = made_up()
    assert answer.photons[answer.at_star] == configuration().photons == 100
    others = np.array([5.0, 14.0, 40.0, 90.0, 320.0])
    elsewhere = replace(answer, measured=replace(answer.measured, photons=others))
    assert elsewhere.at_star == 0  # of the stars that were asked for, the faintest


def test_the_level_is_half_of_what_the_baseline_has_with_the_brightest_star() -> None:
    assert made_up().level == pytest.approx(made_up().runs("window")[-1].mean() / 2)
    assert made_up(strehl=0.3).level == 0.3


def test_differences_are_paired_and_wider_for_more_methods() -> None:
    """Air that is the same scatters by 0.02, the methods themselves by 0.001."""
    answer = made_up()
    expected = strehl_of(magnitudes()[3], 0.5) - strehl_of(magnitudes()[3], 0.0)
    found = answer.difference("window+kalman", "window", 3)
    assert found.value == pytest.approx(expected, abs=0.003)  # 4 standard errors
    assert 0.0001 < found.standard_error < 0.002 < 0.005 < answer.strehl("window", 3).standard_error
    alone = made_up({name: SHIFTS[name] for name in (*PAIR, "window+kalman")})
    widths = [
        (each.high - each.low) / each.standard_error
        for each in (found, alone.difference("window+kalman", "window", 3))
    ]
    assert widths[0] > widths[1] > 2 * 3.18  # Student's t of one comparison with 3 degrees of freedom


def test_no_winner_where_the_errors_do_not_tell() -> None:
    shifts = {"brightest": -2.0, "window": 0.0, "map_predicted": 0.02, "map+kalman": 0.03}
    answer = made_up(shifts, scatter=0.01)
    assert answer.equal(answer.at_star)[0] == "window"
    assert set(answer.equal(answer.at_star)) == {"window", "map_predicted", "map+kalman"}
    text = "\n".join(loop_text.recommendation(answer))
    assert "no winner: the errors do not tell it from" in text
    assert "taken is the baseline" in text


def test_a_winner_is_named_against_the_baseline_first_and_brightest_pixels_second() -> None:
    answer = made_up()
    assert answer.equal(answer.at_star) == ("window+kalman",)
    lines = loop_text.recommendation(answer)
    assert lines[0].startswith("Recommended: window+kalman (loop_gain 0.4")
    assert "no winner" not in "\n".join(lines)
    against = [line for line in lines if line.startswith("against ")]
    assert [line.split(":")[0] for line in against] == ["against window", "against brightest"]
    assert all("±" in line for line in against)


def test_of_equal_methods_without_the_baseline_the_simplest_is_taken() -> None:
    shifts = {"brightest": -2.0, "window": 0.0, "map+kalman": 1.0, "window+kalman": 1.0, "map_predicted": 1.0}
    answer = made_up(shifts, scatter=0.01)
    assert answer.equal(answer.at_star) == ("map_predicted", "window+kalman", "map+kalman")


def test_two_realisations_tell_no_limit_s_error_and_one_no_difference() -> None:
    two = made_up(realisations=2)
    assert two.limit("window").is_known
    assert math.isnan(two.limit("window").error)
    found = two.coverage("window", "galactic pole")
    assert found is not None
    assert found.fraction > 0
    assert math.isnan(found.strehl_error)
    assert "±" not in loop_text.gain_in_words(two, "window", "brightest")
    one = made_up(realisations=1)
    assert one.equal(0)[0] == "window"
    assert set(one.equal(0)) == set(SHIFTS)


def test_limits_and_gains_are_right_within_their_errors() -> None:
    """The curves are known; five magnitudes, 1.1 apart, are read off straight lines."""
    answer = made_up(strehl=BRIGHT / 2)
    for name in ("window", "map_predicted", "window+kalman"):
        limit = answer.limit(name)
        assert limit.magnitude.value == pytest.approx(MIDDLE + SHIFTS[name], abs=3 * limit.error)
        assert 0.01 < limit.error < 0.2
        gain = answer.gain(name, "brightest")
        assert gain.magnitude.value == pytest.approx(SHIFTS[name] + 2.0, abs=3 * gain.error)


def test_straight_curves_have_no_interpolation_error() -> None:
    answer = made_up(scatter=0.0)
    line = 0.9 - 0.15 * (answer.magnitudes - answer.magnitudes[-1])
    strehl = np.broadcast_to(line[:, None], answer.measured.strehl.shape)
    limit = replace(answer, measured=replace(answer.measured, strehl=strehl)).limit("window")
    assert limit.magnitude.value == pytest.approx(answer.magnitudes[-1] + 3.0)
    assert limit.error == pytest.approx(0.0, abs=1e-9)


def test_what_is_beyond_the_measured_magnitudes_is_a_bound() -> None:
    answer = made_up({"brightest": -9.0, "window": 0.0, "map+kalman": 9.0})
    first, last = (f"{answer.magnitudes[place]:.2f}" for place in (-1, 0))
    assert loop_text.limit_in_words(answer, "brightest") == f"<{first}"
    assert loop_text.limit_in_words(answer, "map+kalman") == f">{last}"
    middle, bright = answer.limit("window").magnitude.value, answer.magnitudes[-1]
    assert loop_text.gain_in_words(answer, "window", "brightest") == f">{middle - bright:+.2f}"
    assert loop_text.gain_in_words(answer, "brightest", "window") == f"<{bright - middle:+.2f}"
    for name, sign in (("brightest", -1), ("window", 0), ("map+kalman", 1)):
        found = answer.coverage(name, "latitude 30 degrees")
        assert found is not None
        assert found.bound == sign
        assert loop_text.coverage_in_words(found)[0] == {-1: "<", 0: "0", 1: ">"}[sign]


def test_coverage_is_that_of_the_limiting_magnitude_with_both_errors() -> None:
    answer = made_up(radius_arcsec=20.0)
    limit = answer.limit("window")
    found = answer.coverage("window", "galactic plane")
    assert found is not None
    m = limit.magnitude.value
    assert found.fraction == pytest.approx(float(sky_coverage(m, 20.0, 0.0, "R")))
    ends = sky_coverage(np.array([m - limit.error, m + limit.error]), 20.0, 0.0, "R")
    assert found.strehl_error == pytest.approx(float(np.diff(ends)[0]) / 2)
    # Few stars: the fraction is as uncertain as their number.
    assert found.model_error == pytest.approx(MODEL_ERROR * found.fraction, rel=0.05)


def test_without_turbulence_above_the_ground_the_radius_must_be_given() -> None:
    ground = configuration().replace("atmosphere", altitude_m=(0.0,) * 4)
    answer = made_up()
    answer = replace(answer, question=replace(answer.question, configuration=ground))
    assert answer.coverage("window", "galactic pole") is None
    assert "--radius-arcsec" in loop_text.about_the_sky(answer)[0]
    answer = replace(answer, question=replace(answer.question, radius_arcsec=10.0))
    assert answer.coverage("window", "galactic pole") is not None


def test_saved_settings_and_loop_can_be_loaded(tmp_path: Path) -> None:
    target = tmp_path / "mine.toml"
    answer = made_up()
    loop = answer.save(target)
    settings = Settings.load(target)
    assert (settings.estimator.name, settings.window_fwhm_px, settings.flux_e) == ("window", 3.0, 100.0)
    assert Calibration.load(target).read_noise_e == 3.0
    table = tomllib.loads(target.read_text())["loop"]
    assert (table["method"], table["control"], table["gain"]) == ("window+kalman", "kalman", 0.4)
    assert table["centroid_gain"] == 0.9
    again = load_loop(loop)
    assert (again.photons, again.control.gain) == (100.0, 0.4)


def test_figure() -> None:
    pytest.importorskip("matplotlib")
    figure = loop_figure(made_up())
    left, right = sorted(figure.axes, key=lambda axes: axes.get_position().x0)
    assert left.get_ylabel() == "Strehl ratio at 1.65 µm"
    assert len(right.patches) == 3 * len(SHIFTS)


def test_unknown_methods_are_refused() -> None:
    answer: LoopAnswer = made_up()
    with pytest.raises(InputError, match="expected one that was tried: brightest, window"):
        answer.runs("tv")
