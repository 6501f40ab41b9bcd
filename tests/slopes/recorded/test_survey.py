"""First look at recorded frames."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import faintspot as fs
from faintspot.io.frames import open_frames
from faintspot.slopes.estimators.spot_tables import gaussian_psf
from faintspot.slopes.recorded.survey import UsualFrames, frames_apart, response, stretches
from faintspot.slopes.spots.speckled import speckled_images


def test_frames_unlike_most_and_repeated_ones_are_known_across_blocks() -> None:
    frames = np.random.default_rng(1).normal(10.0, 1.0, (8, 20, 20))
    frames[2] = 10 + 5 * (frames[2] - 10)
    frames[6] = frames[5]
    looked = UsualFrames()
    for block in np.split(frames, 4):
        assert looked.seen(block) is block
    assert np.flatnonzero(looked.unlike).tolist() == [2]
    assert np.flatnonzero(looked.repeated).tolist() == [6]


def test_frames_apart_are_every_eighth_of_the_stretches(tmp_path: Path) -> None:
    """Of 1025 frames 20 stretches of 50, which overlap nowhere; each frame has its number."""
    frames = np.broadcast_to(np.arange(1025, dtype=np.uint16)[:, None, None], (1025, 4, 4))
    np.save(tmp_path / "frames.npy", frames)
    with open_frames([tmp_path / "frames.npy"]) as source:
        every = np.concatenate([block[:, 0, 0] for block in stretches(source)])
        apart = np.concatenate([block[:, 0, 0] for block in frames_apart(source)])
    assert len(every) == 1000
    np.testing.assert_array_equal(apart, every.reshape(20, 50)[:, ::8].ravel())


SIDE, N, FRAMES, FLUX_E = 12, 4, 1500, 40.0


@cache
def movie(shift_px: float) -> np.ndarray:
    """Speckled spots that move by 1 px rms, without noise, all displaced by the shift along x."""
    moved = np.random.default_rng(1).normal([shift_px, 0.0], 1.0, (FRAMES * N, 2))
    images = speckled_images(
        moved, d_over_r0=2.0, shape=(SIDE, SIDE), size=1.0, flux_e=FLUX_E, rng=np.random.default_rng(2)
    )
    return images.reshape(FRAMES, N * SIDE, SIDE).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("width_px", [2.5, 5.0])
def test_response_of_moving_speckled_spots(width_px: float) -> None:
    """Within 4 % of what a displacement of all frames shows: its finite step, and speckles that differ."""
    layout = fs.Layout.stacked(N, (SIDE, SIDE))
    settings = fs.Settings("window", flux_e=FLUX_E, spot_fwhm_px=2.5, window_fwhm_px=width_px)
    pipeline = fs.SlopePipeline(layout, settings, fs.Calibration(dark=0.0))
    ahead, behind = (pipeline(movie(step)).x.mean() for step in (0.2, -0.2))
    shown = response(pipeline, movie(0.0).mean(axis=0), [])
    assert shown[:N].mean() == pytest.approx((ahead - behind) / 0.4, rel=0.04)
    assert shown.mean() < 0.95


@pytest.mark.slow
def test_response_is_the_regression_of_slopes_on_displacements() -> None:
    """Within 5 % for spots so faint that some are lost."""
    layout = fs.Layout.grid((2, 2), pixels=SIDE, origin=(4, 4), frame_shape=(2 * SIDE + 8, 2 * SIDE + 8))
    settings = fs.Settings("weighted", spot_fwhm_px=2.5, weight_fwhm_px=3.0)
    pipeline = fs.SlopePipeline(layout, settings, fs.Calibration(dark=0.0))
    rng = np.random.default_rng(3)
    moved = rng.normal(0.0, 1.5, (4 * FRAMES, N, 2))
    spots = gaussian_psf(np.array([[2.5, 2.5]])).images(moved.reshape(-1, 2), (SIDE, SIDE), 25.0)
    rows = spots.reshape(-1, 2, 2, SIDE, SIDE).swapaxes(2, 3).reshape(-1, 2 * SIDE, 2 * SIDE)
    mean = np.pad(np.maximum(rows, 0), ((0, 0), (4, 4), (4, 4)))
    frames = (rng.poisson(mean) + rng.normal(0.0, 2.0, mean.shape)).astype(np.float32)
    slopes = pipeline(frames)
    shown = response(pipeline, frames.mean(axis=0), [frames])
    for shown_axis, found, true in zip(np.split(shown, 2), (slopes.x, slopes.y), moved.T, strict=True):
        expected = (found * true.T).sum() / np.square(true).sum()
        assert expected < 0.9
        assert shown_axis.mean() == pytest.approx(expected, rel=0.05)
