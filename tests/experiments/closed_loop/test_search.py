"""The search for the best options."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import SEARCH, small
from tests.refusals import assert_each_refused

from faintspot.experiments.closed_loop import search as tuning
from faintspot.experiments.closed_loop.results import LOOP_GAIN, tuned_values
from faintspot.experiments.closed_loop.search import (
    FIRST_TUNING_REALISATION,
    Search,
    Tuned,
    smoothed,
    stored,
    tune,
)
from faintspot.loop.simulation.methods import Method

BRIGHTEST = Method.named("brightest")
KEPT = tuned_values(BRIGHTEST, small())["keep_brightest"]
BEST = KEPT.values[2]
GAINS = tuned_values(BRIGHTEST, small())[LOOP_GAIN]
TOP = 0.55  # between two values on offer


def tuned(kind: Method, search: Search, *more: Any) -> Tuned:
    return stored(tune(kind, small(), search, *more))


@pytest.fixture
def stands_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[float, int], float]], list[Any]]:
    """Let the Strehl ratio be a function of loop gain and pixels kept; return what it is asked for."""

    def stand_in(strehl: Callable[[float, int], float]) -> list[Any]:
        asked: list[Any] = []

        def simulate(configuration: Any, methods: Any, *, realisation: int) -> Any:
            gain, kept = methods[0].gain, methods[0].settings.keep_brightest
            asked.append((realisation, configuration.run.frames, gain, kept))
            return SimpleNamespace(mean_strehl=lambda: strehl(gain, kept))

        monkeypatch.setattr(tuning, "simulate_loop", simulate)
        return asked

    return stand_in


@pytest.fixture
def hill(stands_in: Any) -> list[Any]:
    """A loop whose Strehl ratio is highest at TOP and the best number of pixels; what was simulated."""
    return stands_in(lambda gain, kept: 1 - np.log(gain / TOP) ** 2 - 0.1 * np.log(kept / BEST) ** 2)  # type: ignore[no-any-return]


def test_finds_the_top(hill: list[Any]) -> None:
    told: list[int] = []
    found = tuned(BRIGHTEST, Search(rounds=9), None, told.append)
    assert found.choice == {LOOP_GAIN: TOP, "keep_brightest": BEST}
    assert found.strehl == pytest.approx(1, abs=0.01)  # of the nearest values on offer
    assert min(hill)[0] >= FIRST_TUNING_REALISATION
    assert told == sorted(told)


def test_climbs_the_second_hill_too(stands_in: Any) -> None:
    low, middle, high = (GAINS.values.index(gain) for gain in GAINS.first)
    assert low > 0
    assert middle - low >= 3  # a top that no first choice is at
    heights = np.zeros(len(GAINS.values))
    heights[low - 1 : low + 2] = 0.6, 0.45, 0.3
    heights[middle], heights[high] = 0.4, 0.5
    stands_in(lambda gain, kept: heights[GAINS.values.index(gain)] - (kept != KEPT.first[0]))
    for climbs, top in ((1, high), (2, low - 1)):  # the first is the best of the coarse ones
        found = tuned(BRIGHTEST, Search(climbs=climbs)).choice[LOOP_GAIN]
        assert GAINS.nearest(found).values == (GAINS.values[top],)


def test_looks_at_no_choice_twice(stands_in: Any) -> None:
    looks = stands_in(lambda gain, kept: -abs(gain - TOP))
    tune(BRIGHTEST, small(), Search(rounds=9, realisations=1))
    assert len(looks) == len(set(looks))


def test_without_rounds_the_best_coarse_choice(hill: list[Any]) -> None:
    found = tuned(BRIGHTEST, tuning.QUICK)
    nearest = min(KEPT.first, key=lambda kept: abs(np.log(kept / BEST)))
    assert found.choice == {LOOP_GAIN: GAINS.first[-1], "keep_brightest": nearest}


@pytest.mark.slow
def test_is_repeatable_and_stored() -> None:
    assert_each_refused(Search, coarse_frames=[60], frames=[60, 100.5], rounds=[-1], climbs=[0])
    centroid = Method.named("centroid")
    one, other = (tune(centroid, small(), SEARCH) for _ in range(2))
    assert stored(one) == stored(other)
    np.testing.assert_array_equal(one["strehl"], other["strehl"])
    assert 0 < one["strehl"] < 1


def test_of_known_slopes_only_the_gain_is_tuned(hill: list[Any]) -> None:
    """And nothing of control that learns."""
    slopes = {LOOP_GAIN: GAINS.values[-3], "keep_brightest": BEST + 1}
    kind = Method.named("brightest+kalman")
    highest = max(tuned_values(kind, small())[LOOP_GAIN].values)
    assert tuned(kind, Search(rounds=9), slopes).choice == {**slopes, LOOP_GAIN: highest}
    assert not hill
    assert tuned(BRIGHTEST, Search(), slopes).choice == {**slopes, LOOP_GAIN: TOP}


def test_options_follow_a_power_of_the_flux() -> None:
    """One wrong value among five does not change the line."""
    kind, fluxes = Method.named("window"), (20.0, 40.0, 80.0, 160.0, 320.0)
    stars = [small().replace("camera", photons_per_subaperture=flux) for flux in fluxes]
    power = [2.0 * (flux / 20) ** 0.2 for flux in fluxes]
    choices = [{LOOP_GAIN: 0.1 * k, "window_fwhm_px": width} for k, width in enumerate(power)]
    choices[1]["window_fwhm_px"] = 3.5
    found = smoothed(kind, stars, choices)
    np.testing.assert_allclose([each["window_fwhm_px"] for each in found], power, rtol=5e-3)
    assert [each[LOOP_GAIN] for each in found] == [each[LOOP_GAIN] for each in choices]
    assert smoothed(kind, stars[:2], choices[:2]) == choices[:2]
    whole = [{LOOP_GAIN: 0.1, "keep_brightest": kept} for kept in KEPT.values[:3]]
    assert smoothed(BRIGHTEST, stars[:3], whole) == whole  # numbers of pixels
