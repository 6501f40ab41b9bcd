import math
from functools import partial

import numpy as np
import pytest
from tests.experiments.loop_answer_cases import configuration
from tests.refusals import assert_each_refused, refused

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.question import (
    PLACES,
    LoopQuestion,
    isoplanatic_angle_arcsec,
    magnitudes_apart,
    sky_coverage,
    star_density,
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


def test_bad_values_are_named() -> None:
    good = partial(LoopQuestion, configuration())
    assert_each_refused(
        good, magnitudes=[(8.0,), (8.0, 8.0), (8.0, 99.0)], strehl=[0.0, 1.5], radius_arcsec=[-1]
    )
    for methods, message in (
        (["kog"], "method = 'kog'"),
        (["window+kalmann"], "control of the method = 'kalmann'"),
    ):
        with refused(message):
            good(methods=methods)


def test_other_mistakes() -> None:
    with refused("expected a faintspot.loop.simulation.LoopConfiguration, got str"):
        LoopQuestion("canary")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="learns from a closed loop"):
        LoopQuestion(load_loop("open_loop"), methods=["window+kalman"])
    with pytest.raises(InputError, match="the brightest leaves"):
        LoopQuestion(configuration(), magnitudes=(30.0, 35.0)).photons(3)


def test_fewer_stars_far_from_the_plane_and_more_faint_ones() -> None:
    magnitudes = np.arange(8.0, 20.0)
    densities = np.stack([star_density(magnitudes, latitude) for latitude in (90, 45, 25, 0)])
    assert np.all(np.diff(densities, axis=0) > 0)
    assert np.all(np.diff(densities, axis=1) > 0)


def test_the_pole_has_the_counts_of_the_model_there() -> None:
    """The formula without its factors for direction, which are 1 at the pole, by hand for V = 15.75."""
    disk = 925.0 / 2**3
    spheroid = 1050.0 * 10 ** (0.087 * -1.75) / (1 + 10 ** (-0.18 * -1.75)) ** 2.5
    assert star_density(15.75, 90.0) == pytest.approx(disk + spheroid, rel=1e-6)


def test_the_mean_over_the_sky_is_that_of_the_catalogues() -> None:
    """Latitudes by equal areas; 10 %, as the model's steep rise towards 20 degrees is sampled coarsely."""
    latitudes = np.degrees(np.arcsin((np.arange(20) + 0.5) / 20))
    for magnitude, mean in ((12.0, 71.65), (15.0, 954.8)):
        found = np.mean([star_density(magnitude, latitude) for latitude in latitudes])
        assert found == pytest.approx(mean, rel=0.1)


def test_colour_shifts_the_band() -> None:
    assert star_density(14.0, 60.0, "R") == pytest.approx(star_density(14.45, 60.0))


def test_coverage_is_a_probability() -> None:
    few = sky_coverage(10.0, 10.0, 90.0)
    expected = float(star_density(10.0, 90.0)) * math.pi * (10.0 / 3600) ** 2
    assert few == pytest.approx(expected, rel=1e-3)  # one star is rare, two are not to be expected
    for latitude in PLACES.values():
        assert np.all(sky_coverage([8.0, 18.0], 120.0, latitude) <= 1.0)


def test_isoplanatic_angle_of_one_layer() -> None:
    """0.314 r0 / h."""
    configuration = load_loop("canary").replace(
        "atmosphere",
        r0_m=0.1,
        altitude_m=(10000.0,),
        fraction=(1.0,),
        wind_speed_m_per_s=(10.0,),
        wind_direction_deg=(0.0,),
    )
    r0 = 0.1 * (configuration.science.wavelength_m / 500e-9) ** 1.2
    expected = 0.314 * r0 / 10000.0 * 206265.0
    assert isoplanatic_angle_arcsec(configuration) == pytest.approx(expected, rel=1e-4)


def test_what_is_refused() -> None:
    assert_each_refused(
        partial(star_density, magnitude=14.0, latitude_deg=90.0),
        latitude_deg=[91.0],
        band=["Q"],
        magnitude=[25.0, math.nan],
    )
