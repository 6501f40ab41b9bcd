"""r0 from differential image motion."""

from __future__ import annotations

import numpy as np
import pytest

from faintspot.loop.turbulence.slope_covariance import ARCSEC, SlopeTurbulence
from faintspot.loop.turbulence.strength import differential_image_motion

CELLS = np.argwhere(np.hypot(*(np.indices((7, 7)) - 3)) < 3.6)


def site(r0_m: float, outer_scale_m: float = 25.0) -> SlopeTurbulence:
    positions = np.asarray(0.6 * CELLS[:, ::-1], np.float64)
    return SlopeTurbulence(
        positions, 0.6, 0.3 * ARCSEC, r0_m, outer_scale_m, np.ones(1), np.array([[10.0, 0.0]])
    )


@pytest.mark.parametrize("r0_m", [0.08, 0.25])
@pytest.mark.parametrize("outer_scale_m", [25.0, 100.0])
def test_r0_of_independent_frames_with_noise_and_vibration(r0_m: float, outer_scale_m: float) -> None:
    """Within 7 %: squares are taken for discs (1 %), an outer scale of 25 m adds 4 %, 2000 frames scatter."""
    turbulence, rng = site(r0_m, outer_scale_m), np.random.default_rng(1)
    covariance = turbulence.covariance_px2()
    slopes = rng.multivariate_normal(np.zeros(len(covariance)), covariance, 2000, method="cholesky")
    slopes += rng.normal(0, 5.0, (2000, 1)) + rng.normal(0, 0.2, slopes.shape)
    r0, error = differential_image_motion(slopes, np.full(len(covariance), 0.04), turbulence, 10.0)
    assert abs(r0 / r0_m - 1) < 0.07
    assert 0.01 < error / r0 < 0.05


def test_noise_alone_has_no_r0() -> None:
    slopes = np.random.default_rng(2).normal(0, 1.0, (500, 2 * len(CELLS)))
    assert np.isnan(differential_image_motion(slopes, np.full(2 * len(CELLS), 1.1), site(0.1), 10.0)).all()


def test_sub_apertures_that_are_too_near_tell_nothing() -> None:
    turbulence = SlopeTurbulence(
        np.array([[0.0, 0.0], [0.6, 0.0]]), 0.6, ARCSEC, 0.1, 25.0, np.ones(1), np.zeros((1, 2))
    )
    slopes = np.random.default_rng(3).normal(0, 1.0, (500, 4))
    assert np.isnan(differential_image_motion(slopes, np.zeros(4), turbulence, 10.0)).all()
