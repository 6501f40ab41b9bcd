from __future__ import annotations

from typing import Any

import pytest
from tests.experiments.loop_answer_cases import configuration
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.question import (
    LoopQuestion,
    isoplanatic_angle_arcsec,
    magnitudes_apart,
)
from faintspot.loop.simulation.configuration.configuration import load_loop


def names(question: LoopQuestion) -> list[str]:
    return [kind.name for kind in question.kinds]


def test_default_candidates() -> None:
    question = LoopQuestion(configuration())
    assert names(question) == ["brightest", "window", "map_predicted", "window+kalman", "map+kalman"]
    assert question.left_out == {}
    opened = LoopQuestion(load_loop("open_loop"))
    assert not any("+" in name for name in names(opened))
    assert set(opened.left_out) == {"window+kalman", "map+kalman"}


def test_references_and_what_others_start_from_always_take_part() -> None:
    question = LoopQuestion(configuration(), methods=["tv", "map+kalman"])
    assert names(question) == ["brightest", "window", "tv", "map_predicted", "map+kalman"]


def test_fluxes() -> None:
    question = LoopQuestion(configuration())  # 100 photons; 20 to 320 in its runs
    fluxes = question.photons(5)
    assert fluxes[0] == 5.0
    assert fluxes[-1] == 320.0
    assert 100.0 in fluxes
    assert magnitudes_apart(fluxes) < 1.5
    alone = configuration().replace("run", photons_per_subaperture=())
    assert LoopQuestion(alone).photons(3) == (12.5, 100.0, 400.0)
    given = LoopQuestion(configuration(), magnitudes=(14.0, 12.5)).photons(3)
    expected = configuration().photometry.electrons([14.0, 12.5])
    assert given[0] == pytest.approx(expected[0], rel=1e-3)
    assert given[2] == pytest.approx(expected[1], rel=1e-3)
    assert 100.0 not in given  # it is brighter than these


def test_radius() -> None:
    question = LoopQuestion(configuration())
    assert question.radius == isoplanatic_angle_arcsec(configuration())
    assert LoopQuestion(configuration(), radius_arcsec=30).radius == 30.0
    assert LoopQuestion(configuration().replace("atmosphere", altitude_m=(0.0,) * 4)).radius is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"magnitudes": (8.0,)}, "magnitudes: expected a first and another last one"),
        ({"magnitudes": (8.0, 8.0)}, "magnitudes: expected a first and another last one"),
        ({"magnitudes": (8.0, 99.0)}, "magnitudes = 99: expected a number from -30 to 60"),
        ({"strehl": 0.0}, "strehl = 0: expected a number above 0"),
        ({"strehl": 1.5}, "strehl = 1.5"),
        ({"radius_arcsec": -1}, "radius_arcsec = -1"),
        ({"methods": ["kog"]}, "method = 'kog'"),
        ({"methods": ["window+kalmann"]}, "control of the method = 'kalmann'"),
    ],
)
def test_bad_values_are_named(values: dict[str, Any], message: str) -> None:
    with refused(message):
        LoopQuestion(configuration(), **values)


def test_other_mistakes() -> None:
    with refused("expected a faintspot.loop.simulation.LoopConfiguration, got str"):
        LoopQuestion("canary")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="learns from a closed loop"):
        LoopQuestion(load_loop("open_loop"), methods=["window+kalman"])
    with pytest.raises(InputError, match="the brightest leaves"):
        LoopQuestion(configuration(), magnitudes=(30.0, 35.0)).photons(3)
