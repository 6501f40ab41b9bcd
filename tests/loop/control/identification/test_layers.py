from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.control_cases import TURBULENCE
from tests.loop.control.frozen_flow import frozen_slopes
from tests.refusals import refused

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.layers import Identification, Identified
from faintspot.loop.control.identification.vibrations import Vibration, mode_shapes

RATE_HZ = 250.0
CELLS = np.array([[row, column] for row in range(5) for column in range(5)], np.float64)
AIR = replace(
    TURBULENCE,
    positions_m=CELLS * 0.6,
    fraction=np.array([0.6, 0.4]),
    wind_m_per_s=np.array([[6.0, 2.0], [-5.0, 14.0]]),
)
UNKNOWN = replace(AIR, r0_m=1.0, outer_scale_m=20.0, fraction=np.ones(1), wind_m_per_s=np.zeros((1, 2)))


def observed(
    air: object = AIR, frames: int = 1500, noise_px: float = 0.5, seed: int = 1
) -> OpenLoopTelemetry:
    """Return slopes with noise, whose errors are said to be 1.2 times too large."""
    rng = np.random.default_rng(seed)
    assert isinstance(air, type(AIR))
    slopes = frozen_slopes(air, frames, RATE_HZ, rng)
    slopes += noise_px * rng.standard_normal(slopes.shape)
    return OpenLoopTelemetry(slopes, np.full(slopes.shape, (1.2 * noise_px) ** 2), np.ones(slopes.shape))


def expect_winds(found: Identified, within_m_per_s: float) -> None:
    """The strongest layers are those of AIR, within three of their standard errors and so many m/s."""
    order = np.argsort(-found.turbulence.fraction)[: len(AIR.fraction)]
    off = found.turbulence.wind_m_per_s[order] - AIR.wind_m_per_s
    assert np.abs(off).max() < within_m_per_s
    assert np.all(np.abs(off) < 4 * found.wind_error_m_per_s[order])
    assert found.turbulence.fraction[order] == pytest.approx(AIR.fraction, abs=0.12)


@pytest.mark.slow
def test_two_layers_are_found() -> None:
    found = Identification(observed(), UNKNOWN, RATE_HZ).layers()
    assert 2 <= len(found.turbulence.fraction) <= 3
    expect_winds(found, 0.8)
    assert found.noise_factor == pytest.approx(1.2**-2, rel=0.03)
    assert found.turbulence.r0_m == pytest.approx(AIR.r0_m, rel=0.1)
    assert found.vibrations == ()
    assert found.slope_model().layers == len(found.turbulence.fraction)


@pytest.mark.slow
def test_gradients_of_smaller_squares_are_found() -> None:
    """Slopes of bright stars that follow the least-squares tilt, with unequal centroid gains."""
    telemetry = observed(replace(AIR, averaged=0.7), noise_px=0.1)
    gains = 1 + 0.1 * np.random.default_rng(5).standard_normal(telemetry.open_loop_px.shape[1])
    unequal = replace(telemetry, open_loop_px=gains * telemetry.open_loop_px)
    found = Identification(unequal, UNKNOWN, RATE_HZ).layers()
    assert found.turbulence.averaged == 0.7
    order = np.argsort(-found.turbulence.fraction)[:2]
    assert found.turbulence.wind_m_per_s[order] == pytest.approx(AIR.wind_m_per_s, abs=0.4)
    assert found.turbulence.fraction[order] == pytest.approx(AIR.fraction, abs=0.1)


@pytest.mark.slow
def test_gaps_and_slopes_that_tell_little_do_not_count() -> None:
    """A twentieth of the slopes, sixty frames and three sub-apertures were not measured.

    A fifth is mostly an estimator's prior, with three times the stated error.
    """
    telemetry, rng = observed(), np.random.default_rng(4)
    poor, missing = rng.random(telemetry.open_loop_px.shape) < 0.2, rng.random(telemetry.trust.shape) < 0.05
    wrong = 0.5 * np.sqrt(90.0) * rng.standard_normal(poor.shape)
    missing[400:420] = missing[900:940] = True
    missing[:, [3, 7, 12, 28, 32, 37]] = True
    damaged = OpenLoopTelemetry(
        np.where(missing, 50.0, telemetry.open_loop_px + np.where(poor, wrong, 0.0)),
        np.where(missing, np.inf, np.where(poor, 10.0, 1.0) * telemetry.variance_px2),
        np.where(missing, 0.0, 1.0),
    )
    found = Identification(damaged, UNKNOWN, RATE_HZ).layers()
    expect_winds(found, 1.0)
    # Interpolation in their place halves the noise of a fifth.
    assert found.noise_factor == pytest.approx(1.2**-2, rel=0.2)


@pytest.mark.slow
def test_turbulence_that_stands_still() -> None:
    """In windows of half a second winds below 2 m/s look alike: no layer is faster than that by much."""
    still = replace(AIR, fraction=np.ones(1), wind_m_per_s=np.array([[0.4, 0.0]]))
    found = Identification(observed(still), UNKNOWN, RATE_HZ).layers()
    assert np.hypot(*found.turbulence.wind_m_per_s.T).max() < 4.0


@pytest.mark.slow
def test_known_winds_have_their_strengths() -> None:
    identification = Identification(observed(frames=500), UNKNOWN, RATE_HZ)
    found = identification.of_winds(AIR.wind_m_per_s)
    assert found.turbulence.fraction == pytest.approx(AIR.fraction, abs=0.1)
    assert found.criterion < identification.anywhere().criterion
    assert found.covariances_px2().shape == (2, 3, 50, 50)
    assert identification.anywhere().covariances_px2().shape == (1, 3, 50, 50)


@pytest.mark.slow
def test_a_vibration_is_found_and_part_of_the_model() -> None:
    """A tilt of 45 Hz on top of turbulence: the winds stay what they are."""
    telemetry = observed()
    shape = mode_shapes(AIR.positions_m)[1]
    shaking = 4.0 * np.sin(2 * np.pi * 45.0 / RATE_HZ * np.arange(len(telemetry)) + 1)  # 0.4 px of 50 slopes
    shaken = replace(telemetry, open_loop_px=telemetry.open_loop_px + shaking[:, None] * shape)
    found = Identification(shaken, UNKNOWN, RATE_HZ).layers()
    (vibration,) = found.vibrations
    assert vibration.mode == "tilt"
    assert vibration.frequency_hz == pytest.approx(45.0, abs=0.1)
    assert vibration.rms_px == pytest.approx(0.4, rel=0.15)
    expect_winds(found, 0.8)
    model = found.slope_model()
    assert model.layers == len(found.turbulence.fraction) + 1
    assert np.abs(np.linalg.eigvals(model.onward)).max() < 1.0


def test_a_single_aperture_has_no_focus() -> None:
    """Tip and tilt alone: layers are told by how fast they change."""
    single = replace(UNKNOWN, positions_m=np.zeros((1, 2)), subaperture_m=3.0)
    slopes = np.random.default_rng(2).standard_normal((600, 2)).cumsum(axis=0) * 0.1
    telemetry = OpenLoopTelemetry(slopes, np.full(slopes.shape, 0.01), np.ones(slopes.shape))
    found = Identification(telemetry, single, RATE_HZ).layers()
    assert found.vibrations == ()
    assert np.isfinite(found.slope_model().both).all()


def test_too_little_is_refused() -> None:
    telemetry = observed(frames=100)
    with refused("telemetry", "32"):
        Identification(telemetry.part(0, 20), UNKNOWN, RATE_HZ)
    unmeasured = replace(telemetry, variance_px2=np.full(telemetry.variance_px2.shape, np.inf))
    with refused("none"):
        Identification(unmeasured, UNKNOWN, RATE_HZ)


@pytest.mark.slow
def test_waves_between_the_subapertures_are_no_vibration() -> None:
    """Winds are fitted to 40 of 80 sub-apertures, every other column: there alone a wave is tip."""
    cells = np.argwhere(np.ones((10, 8)))
    column, time_s = cells[:, 1] - 3.5, np.arange(1500) / RATE_HZ
    wave = np.cos(np.pi * (column - 0.5)) + 4 / 42 * column  # without tip and focus
    slopes = 0.1 * np.random.default_rng(4).standard_normal((1500, 160))
    slopes[:, :80] += 0.3 * wave * np.sin(2 * np.pi * 16.0 * time_s)[:, None]
    site = replace(UNKNOWN, positions_m=np.asarray(0.6 * cells[:, ::-1], np.float64))
    winds = np.array([[9.0, 0.0]])

    def found() -> tuple[Vibration, ...]:
        telemetry = OpenLoopTelemetry(slopes, np.full(slopes.shape, 0.01), np.ones(slopes.shape))
        return Identification(telemetry, site, RATE_HZ, [1.0]).of_winds(winds).vibrations

    assert found() == ()
    slopes[:, :80] += 0.1 * np.sin(2 * np.pi * 31.0 * time_s)[:, None]
    (line,) = found()
    assert line.mode == "tip"
    assert line.frequency_hz == pytest.approx(31.0, abs=0.1)
