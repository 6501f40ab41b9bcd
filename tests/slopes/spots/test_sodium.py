"""Sodium profiles: their convention, their moments and their checks."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused

import faintspot as fs
from faintspot.slopes.spots.sodium import integration_points


def test_moments_are_those_of_the_layers() -> None:
    profile = fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 2e3], [3.0, 1.0], bins=201)
    assert profile.mean_m == pytest.approx(0.75 * 86e3 + 0.25 * 95e3, abs=20.0)
    variance = (0.75 * 4e3**2 + 0.25 * 2e3**2) / 5.545 + 0.75 * 0.25 * 9e3**2
    # Layers are cut at 3.5 standard deviations, and linear between altitudes.
    assert profile.std_m == pytest.approx(np.sqrt(variance), rel=5e-3)
    assert np.trapezoid(profile.density, profile.altitudes_m) == pytest.approx(1.0)


def test_scale_and_grid_do_not_matter() -> None:
    profile = fs.SodiumProfile.gaussian()
    brighter = fs.SodiumProfile(profile.altitudes_m, 1e5 * profile.density)
    np.testing.assert_allclose(brighter.density, profile.density, rtol=1e-12)
    finer = profile.at(np.linspace(profile.altitudes_m[0], profile.altitudes_m[-1], 401))
    assert finer.std_m == pytest.approx(profile.std_m, rel=1e-3)


@pytest.mark.parametrize("steps", [1, 3])
def test_points_hold_all_the_flux(steps: int) -> None:
    altitudes = np.array([80e3, 81e3, 84e3])
    points, parts = integration_points(altitudes, steps)
    assert len(points) == 2 * steps
    np.testing.assert_allclose(parts.sum(axis=0), [500.0, 2000.0, 1500.0])


def test_a_file_gives_it_back(tmp_path: Path) -> None:
    profile = fs.SodiumProfile.gaussian(91e3, 8e3)
    profile.save(tmp_path / "sodium.npz")
    back = fs.SodiumProfile.load(tmp_path / "sodium.npz")
    np.testing.assert_allclose(back.density, profile.density, rtol=1e-12)


def test_impossible_profiles_are_refused() -> None:
    assert_each_refused(
        partial(fs.SodiumProfile, altitudes_m=[80e3, 90e3], density=[1.0, 1.0]),
        altitudes_m=[[90e3, 80e3], [80e3, 80e3], [80e3]],
        density=[[1.0, -0.1], [0.0, 0.0], [1.0, np.nan], [1.0]],
    )
    layer: dict[str, Any] = {"means_m": [90e3], "fwhms_m": [5e3], "fractions": [1.0]}
    assert_each_refused(
        partial(fs.SodiumProfile.peaks, **layer), fwhms_m=[[0.0]], means_m=[[90e3, 95e3]], bins=[1]
    )
    assert_each_refused(fs.SodiumProfile.gaussian().at, altitudes_m=[[95e3, 90e3]])
