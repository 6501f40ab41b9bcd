from typing import Any

import numpy as np
import pytest
from tests.loop.simulation.loop_cases import quiet
from tests.refusals import refused
from tests.shared_data import skip_without

from faintspot.loop.simulation import LoopConfiguration, load_loop
from faintspot.loop.simulation.atmosphere import make_atmosphere

skip_without("hcipy")
NM_TO_RAD = 2 * np.pi / 500


def _one_layer() -> LoopConfiguration:
    layer: Any = {"altitude_m": (0.0,), "fraction": (1.0,)}
    return quiet().replace("atmosphere", **layer, wind_speed_m_per_s=(10.0,), wind_direction_deg=(0.0,))


def _von_karman(separations_m: np.ndarray) -> np.ndarray:
    """Return the structure function, rad^2."""
    import hcipy

    coordinates = hcipy.UnstructuredCoords((separations_m, np.zeros(len(separations_m))))
    function = hcipy.phase_structure_function_von_karman(0.15, 25.0)
    return np.array(function(hcipy.CartesianGrid(coordinates)))


@pytest.mark.slow
def test_structure_function_is_von_karmans() -> None:
    """Over whole screens: the expectation is met within 5 %, five times what 3 x 4 screens scatter."""
    separations = np.array([1, 2, 4, 12, 40, 80])
    measured = []
    for realisation in range(3):
        atmosphere = make_atmosphere(quiet(), 5, realisation)
        for screen, part in zip(atmosphere.screens, quiet().atmosphere.fraction, strict=True):
            radians = screen * (NM_TO_RAD * 0.15 ** (-5 / 6) / np.sqrt(part))
            measured.append([np.mean((radians - np.roll(radians, s, axis=0)) ** 2) for s in separations])
    expected = _von_karman(separations * 0.05)
    np.testing.assert_allclose(np.mean(measured, axis=0), expected, rtol=0.05)
    # Points 0.1 m apart: interpolation takes 3 to 8 % of the structure function there, no more.
    atmosphere = make_atmosphere(quiet(), 7, 0)
    fronts = np.array([atmosphere.wavefront_nm(t) for t in np.arange(0, 8, 0.05)])
    structure = np.mean((fronts[:, 2:] - fronts[:, :-2]) ** 2) * NM_TO_RAD**2
    assert 0.9 < structure / _von_karman(np.array([0.1]))[0] < 1.0


def test_the_wind_moves_the_atmosphere_along_x() -> None:
    """It goes on where the screen ends; half a point lies between the points."""
    atmosphere = make_atmosphere(_one_layer(), 1)
    first, later = atmosphere.wavefront_nm(0.0), atmosphere.wavefront_nm(4 * 0.05 / 10)  # four points of 5 cm
    np.testing.assert_allclose(later[:, 4:], first[:, :-4], atol=0.2)
    period = len(atmosphere.screens[0]) * 0.05 / 10
    np.testing.assert_allclose(atmosphere.wavefront_nm(period), first, atol=0.2)
    steps = [atmosphere.wavefront_nm(time) for time in (0.0, 0.0025, 0.005)]
    np.testing.assert_allclose(steps[1], (steps[0] + steps[2]) / 2, atol=0.1 * float(np.ptp(steps[0])))
    change = np.std(steps[2] - steps[0])
    assert np.std(steps[1] - steps[0]) == pytest.approx(change / 2, rel=0.15)
    jumps = [
        np.std(atmosphere.wavefront_nm(t + 0.004) - atmosphere.wavefront_nm(t))
        for t in np.arange(0, period, 0.5)
    ]
    assert max(jumps) < 2 * np.median(jumps)


@pytest.mark.slow
def test_realisations_and_seeds_differ_and_repeat() -> None:
    wavefronts = [make_atmosphere(quiet(), *which).wavefront_nm(1.0) for which in ((1, 0), (1, 1), (2, 0))]
    np.testing.assert_array_equal(wavefronts[0], make_atmosphere(quiet(), 1, 0).wavefront_nm(1.0))
    for other in wavefronts[1:]:
        assert abs(np.corrcoef(wavefronts[0].ravel(), other.ravel())[0, 1]) < 0.95


@pytest.mark.slow
def test_r0_drifts_between_its_ends() -> None:
    atmosphere = make_atmosphere(quiet().replace("atmosphere", r0_m=(0.08, 0.2), drift_time_s=10.0), 3)
    r0 = [atmosphere.r0_m(time) for time in np.linspace(0, 10, 400)]
    assert min(r0) == pytest.approx(0.08, rel=1e-3)
    assert max(r0) == pytest.approx(0.2, rel=1e-3)
    assert atmosphere.r0_m(10.0) == pytest.approx(atmosphere.r0_m(0.0))
    steady = make_atmosphere(quiet(), 3)
    assert steady.r0_m(5.0) == pytest.approx(0.15)


def test_an_outer_scale_too_large_for_the_screens_is_refused() -> None:
    with refused("outer_scale_m = 150"):
        make_atmosphere(load_loop("eight_metre").replace("atmosphere", outer_scale_m=150.0), 1)


def test_another_wind_goes_on_from_the_same_wavefront() -> None:
    """At the moment of the change to 1e-3 of the wavefront's scatter: the rest is rounding of places."""
    atmosphere = make_atmosphere(_one_layer(), 5, 0)
    faster, before = atmosphere.blown(2 * atmosphere.velocity, 300.0).wavefront_nm, atmosphere.wavefront_nm
    scatter = before(300.0).std()
    np.testing.assert_allclose(faster(300.0), before(300.0), atol=1e-3 * scatter)
    np.testing.assert_allclose(faster(300.1), before(300.2), atol=1e-3 * scatter)
    assert np.abs(faster(300.1) - before(300.1)).max() > 0.01 * scatter
