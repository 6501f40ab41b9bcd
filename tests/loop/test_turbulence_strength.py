import math
from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.frozen_flow import frozen_slopes
from tests.patience import mostly_slow

from faintspot.loop.slope_covariance import ARCSEC, SlopeTurbulence
from faintspot.loop.turbulence_strength import (
    _SCALES_M,
    TurbulenceStrength,
    _fitted,
    differential_image_motion,
    turbulence_strength,
)

CELLS = np.argwhere(np.ones((6, 6)))
AIR = SlopeTurbulence(
    np.asarray(CELLS[:, ::-1] * 0.5, np.float64),
    0.5,
    1e-6,
    0.15,
    25.0,
    np.array([0.7, 0.3]),
    np.array([[8.0, 3.0], [-6.0, 14.0]]),
)
FRAMES = 4000


@pytest.fixture(scope="module")
def slopes() -> np.ndarray:
    """Slopes of 16 s, the first quarter and the third from another piece of turbulence."""
    rng = np.random.default_rng(3)
    return np.vstack([frozen_slopes(AIR, FRAMES // 4, 250.0, rng) for _ in range(4)])


def found(slopes: np.ndarray, **options: float) -> TurbulenceStrength:
    run = np.repeat(np.arange(4), FRAMES // 4)
    return turbulence_strength(slopes, np.zeros_like(slopes), run, AIR, **options)


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_known_turbulence_is_found_within_its_errors(slopes: np.ndarray, noise_px: float) -> None:
    """Within three errors; the noise has as much variance as the turbulence of a slope."""
    noise = noise_px * np.random.default_rng(4).standard_normal(slopes.shape)
    strength = found(slopes + noise)
    assert abs(strength.r0_m - AIR.r0_m) < 2 * strength.r0_error_m < 0.02
    assert abs(math.log(strength.outer_scale_m / 25)) < 1
    known = found(slopes + noise, outer_scale_m=25.0)
    assert known.outer_scale_m == pytest.approx(25)
    assert known.r0_error_m < strength.r0_error_m


def test_one_variance_leaves_the_outer_scale_of_most_sites() -> None:
    """Whatever the outer scale, a strength fits it exactly; the scales that are tried end at 4 and 250 m."""
    fitted = _fitted(np.zeros(1), np.zeros((len(_SCALES_M), 1)), np.eye(1), None)
    assert fitted.outer_scale_m == pytest.approx(25.0, rel=0.05)
    assert fitted.outer_scale_error_m == pytest.approx(0.7 * 25.0, rel=0.1)


@pytest.mark.slow
def test_twice_the_slopes_have_a_smaller_r0(slopes: np.ndarray) -> None:
    """Twice the slopes: r0 is smaller by 2^(6/5)."""
    ratio = found(2 * slopes).r0_m / found(slopes).r0_m
    assert ratio == pytest.approx(2**-1.2, rel=1e-6)


def test_uncertain_gain_adds_to_the_error_of_r0(slopes: np.ndarray) -> None:
    """An uncertain gain of residual slopes adds to the error."""
    run = np.repeat(np.arange(4), FRAMES // 4)
    sure, unsure = (
        turbulence_strength(slopes, 0.5 * slopes, run, AIR, gain_error=each) for each in (0.0, 0.1)
    )
    assert unsure.r0_error_m > sure.r0_error_m
    assert unsure.r0_m == pytest.approx(sure.r0_m, rel=0.05)


def test_noise_alone_and_two_subapertures(slopes: np.ndarray) -> None:
    alternating = np.tile([[1.0], [-1.0]], (FRAMES // 2, 72))
    assert math.isnan(found(alternating).r0_m)
    pair = replace(AIR, positions_m=AIR.positions_m[:2])
    both = slopes[:, [0, 1, 36, 37]]
    strength = turbulence_strength(both, np.zeros_like(both), np.repeat(np.arange(4), FRAMES // 4), pair)
    assert abs(strength.r0_m - AIR.r0_m) < 3 * strength.r0_error_m


def test_noise_alone_has_no_strength() -> None:
    for seed in range(6):
        noise = np.random.default_rng(seed).standard_normal((1200, 72))
        assert np.isnan(turbulence_strength(noise, noise, np.zeros(1200, np.int64), AIR).r0_m)


ROUND_CELLS = np.argwhere(np.hypot(*(np.indices((7, 7)) - 3)) < 3.6)


def site(r0_m: float, outer_scale_m: float = 25.0) -> SlopeTurbulence:
    positions = np.asarray(0.6 * ROUND_CELLS[:, ::-1], np.float64)
    return SlopeTurbulence(
        positions, 0.6, 0.3 * ARCSEC, r0_m, outer_scale_m, np.ones(1), np.array([[10.0, 0.0]])
    )


@pytest.mark.parametrize("r0_m", mostly_slow(1, [0.08, 0.25]))
@pytest.mark.parametrize("outer_scale_m", mostly_slow(1, [25.0, 100.0]))
def test_r0_of_independent_frames_with_noise_and_vibration(r0_m: float, outer_scale_m: float) -> None:
    """Within 7 %: squares are taken for discs (1 %), an outer scale of 25 m adds 4 %, 2000 frames scatter."""
    turbulence, rng = site(r0_m, outer_scale_m), np.random.default_rng(1)
    covariance = turbulence.covariance_px2()
    slopes = rng.multivariate_normal(np.zeros(len(covariance)), covariance, 2000, method="cholesky")
    slopes += rng.normal(0, 5.0, (2000, 1)) + rng.normal(0, 0.2, slopes.shape)
    r0, error = differential_image_motion(slopes, np.full(len(covariance), 0.04), turbulence, 10.0)
    assert abs(r0 / r0_m - 1) < 0.07
    assert 0.01 < error / r0 < 0.05


def test_noise_alone_and_near_sub_apertures_have_no_r0() -> None:
    noise, slopes = np.full(2 * len(ROUND_CELLS), 1.1), 2 * len(ROUND_CELLS)
    seen = np.random.default_rng(2).normal(0, 1.0, (500, slopes))
    assert np.isnan(differential_image_motion(seen, noise, site(0.1), 10.0)).all()
    pair = replace(site(0.1), positions_m=np.array([[0.0, 0.0], [0.6, 0.0]]))
    assert np.isnan(differential_image_motion(seen[:, :4], np.zeros(4), pair, 10.0)).all()


RATE_HZ, SECONDS, PIECES, NOISE_PX = 60.0, 3.0, 10, 0.3
WINDS = {"fast": ([0.5, 0.3, 0.2], [[5.6, 2.1], [-4.1, 11.3], [-12.9, -15.3]]), "slow": ([1.0], [[3.5, 2.0]])}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(WINDS))
def test_intervals_of_pieces_hold(kind: str) -> None:
    """At least 7 of 10 intervals (fewer once in 1000 times, if 95 % hold), median r0 within 10 %.

    The mean of a piece takes up to a third of the variance; without it r0 is 5 to 14 % too large.
    """
    share, winds = WINDS[kind]
    positions = np.asarray(0.6 * ROUND_CELLS[:, ::-1], np.float64)
    air = SlopeTurbulence(positions, 0.6, 0.11 * ARCSEC, 0.2, 25.0, np.array(share), np.array(winds))
    found = []
    for piece in range(PIECES):
        rng = np.random.default_rng([piece, 1])
        slopes = frozen_slopes(air, round(SECONDS * RATE_HZ), RATE_HZ, rng)
        slopes += NOISE_PX * rng.standard_normal(slopes.shape)
        run = np.zeros(len(slopes), np.int64)
        strength = turbulence_strength(slopes, np.zeros_like(slopes), run, air, frame_rate_hz=RATE_HZ)
        noise = np.full(slopes.shape[1], NOISE_PX**2)
        motion = differential_image_motion(slopes, noise, air, RATE_HZ)
        found.append([(strength.r0_m, strength.r0_error_m), motion])
    r0, error = np.moveaxis(np.array(found), 2, 0)
    away = np.abs(np.log(r0 / [air.r0_m, 1.04 * air.r0_m])) / (error / r0)  # an outer scale of 25 m adds 4 %
    assert ((away < 1.96).mean(axis=0) >= 0.7).all()
    assert (away.std(axis=0) > 0.2).all()  # not much too wide either
    assert abs(math.log(np.median(r0[:, 0]) / air.r0_m)) < 0.1
