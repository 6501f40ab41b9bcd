import math

import numpy as np
import pytest

from faintspot.loop.control.identification.open_loop import Measured
from faintspot.loop.telemetry.choices import AS_RUN, BEST, FILTER, ControlChoice, _saved, _signed_root, advice


def choice(name: str, residual: float, less: float, error: float, gain: float = math.nan) -> ControlChoice:
    """Return a choice that leaves a residual, and less than as it ran by `less`."""
    saved = Measured("less than as it ran", "nm", less, error)
    return ControlChoice(name, Measured("residual", "nm", residual, 10.0), saved, saved, saved, gain)


RAN = choice(AS_RUN, 100.0, 0.0, 0.0)


def test_the_choice_that_saves_most_is_recommended() -> None:
    others = [choice(BEST, 90.0, 40.0, 5.0, 0.36), choice(FILTER, 60.0, 80.0, 10.0)]
    assert advice([RAN, *others]).startswith("Use the predictive Kalman filter: it leaves 80 nm (")
    assert "an integrator with a gain of 0.36" in advice([RAN, others[0]])


def test_a_choice_that_is_not_significantly_better_is_not_recommended() -> None:
    assert advice([RAN, choice(FILTER, 95.0, 30.0, 25.0)]).startswith("Keep the control as it is")
    assert advice([]) == ""


def test_an_open_loop_has_the_least_residual_recommended() -> None:
    others = [choice(BEST, 90.0, math.nan, math.nan, 0.36), choice(FILTER, 60.0, math.nan, math.nan)]
    assert advice(others).startswith("Use the predictive Kalman filter: it leaves least")


@pytest.mark.parametrize("square", [-100.0, 100.0])
@pytest.mark.parametrize(("error", "significant"), [(60.0, False), (45.0, True), (5.0, True)])
def test_roots_are_as_significant_as_their_squares(square: float, error: float, significant: bool) -> None:
    low, high = _signed_root("", "nm", square, error).interval
    assert (low > 0 or high < 0) == significant


def test_savings_do_not_depend_on_the_scale_of_the_wavefront() -> None:
    rng = np.random.default_rng(1)
    before = rng.gamma(5.0, size=600)
    after = 0.8 * before
    saved, error = _saved([before, 2 * before], [after, 2 * after], [1.0, 2.0])
    assert saved == pytest.approx(0.2 * before.mean() / (before.mean() - 1.0))
    assert error < 0.02 * saved  # paired: without, the blocks would scatter by 6 %
