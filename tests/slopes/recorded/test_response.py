"""Response of slopes to displacements: of fixed windows from the mean of the frames."""

from __future__ import annotations

import numpy as np
import pytest

import faintspot as fs
from faintspot.slopes.recorded.response import response
from faintspot.slopes.spots.speckled import speckled_images

SIDE, N, FRAMES, FLUX_E = 12, 4, 1500, 40.0


def movie(shift_px: float) -> np.ndarray:
    """Speckled spots that move by 1 px rms, without noise, all displaced by the shift along x."""
    moved = np.random.default_rng(1).normal([shift_px, 0.0], 1.0, (FRAMES * N, 2))
    images, _ = speckled_images(
        moved, d_over_r0=2.0, shape=(SIDE, SIDE), size=1.0, flux_e=FLUX_E, rng=np.random.default_rng(2)
    )
    return images.reshape(FRAMES, N * SIDE, SIDE).astype(np.float32)


@pytest.mark.parametrize("width_px", [2.5, 5.0])
def test_response_of_moving_speckled_spots(width_px: float) -> None:
    """Within 4 % of what a displacement of all frames shows: its finite step, and speckles that differ."""
    layout = fs.Layout.stacked(N, (SIDE, SIDE))
    settings = fs.Settings("window", flux_e=FLUX_E, spot_fwhm_px=2.5, window_fwhm_px=width_px)
    pipeline = fs.SlopePipeline(layout, settings, fs.Calibration(dark=0.0))
    ahead, behind = (pipeline(movie(step)).x.mean() for step in (0.2, -0.2))
    shown = response(pipeline, movie(0.0).mean(axis=0))
    assert shown is not None
    assert shown[:N].mean() == pytest.approx((ahead - behind) / 0.4, rel=0.04)
    assert shown.mean() < 0.95


def test_other_estimators_have_none() -> None:
    layout = fs.Layout.stacked(N, (SIDE, SIDE))
    pipeline = fs.SlopePipeline(layout, fs.Settings("brightest"), fs.Calibration(dark=0.0))
    assert response(pipeline, np.ones((N * SIDE, SIDE))) is None
