"""Star counts, and the fraction of the sky that they cover."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import faintspot as fs
from faintspot.experiments.closed_loop.question import (
    PLACES,
    isoplanatic_angle_arcsec,
    sky_coverage,
    star_density,
)
from faintspot.loop.simulation import load_loop


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((14.0, 91.0), "latitude_deg = 91"),
        ((14.0, 90.0, "Q"), "band = 'Q'"),
        ((25.0, 90.0), "magnitude = 25"),
        ((math.nan, 90.0), "magnitude: expected finite"),
    ],
)
def test_what_is_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(fs.InputError, match=message):
        star_density(*arguments)
