from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot as fs
from faintspot.engine.frames.frame_path import FramePath, Progress
from faintspot.engine.settings.plan import EVERY, DarkFollower, FluxFollower
from faintspot.slopes.pipeline.light import MeanFlux

LAYOUT = fs.Layout.grid((6, 6), pixels=10)
N = len(LAYOUT)
SETTINGS = fs.Settings("window", flux_e=100.0, spot_fwhm_px=2.0)
PIPELINE = fs.SlopePipeline(LAYOUT, SETTINGS, fs.Calibration(dark=100.0, read_noise_e=3.0))
UNLIT = np.isin(np.arange(N), [3, 17, 35])


def frames_of(flux_e: float, n: int, unlit: NDArray[np.bool_] = UNLIT) -> NDArray[np.float32]:
    rng = np.random.default_rng(int(flux_e) + n)
    images = fs.PSF.analytic("gaussian").images(np.zeros((N, 2)), (10, 10), np.where(unlit, 0.0, flux_e))
    mean = images.reshape(6, 6, 10, 10).transpose(0, 2, 1, 3).reshape(60, 60)
    noise = 3.0 * rng.standard_normal((n, 60, 60), np.float32)
    return (rng.poisson(mean, (n, 60, 60)) + 100.0 + noise).astype(np.float32)


def follow(follower: DarkFollower, frames: NDArray[np.float32], rounds: int) -> None:
    """Take frames for a number of rounds through all windows."""
    for number in range(EVERY * rounds):
        follower.take(frames[number % len(frames)][None])


def test_bright_stars_show_it_after_a_few_hundred_frames() -> None:
    follower = DarkFollower(PIPELINE)
    frames = frames_of(5000.0, 97)
    follow(follower, frames, 7)
    assert not follower.look()
    follow(follower, frames, 2)
    assert follower.look()
    assert np.array_equal(follower.dark, UNLIT)
    assert not follower.look()
    follow(follower, frames_of(5000.0, 97, np.zeros(N, np.bool_)), 3)
    assert follower.look()
    assert not follower.dark.any()
    assert follower.changes == 2


def test_faint_stars_take_thousands_of_frames() -> None:
    follower = DarkFollower(PIPELINE)
    frames = frames_of(20.0, 1009)
    follow(follower, frames, 200)
    assert not follower.look()
    follow(follower, frames, 57)
    assert follower.look()
    assert np.array_equal(follower.dark, UNLIT)


@pytest.mark.slow  # compiles a kernel of streams
def test_dark_subapertures_have_slopes_of_0_and_others_the_same() -> None:
    frame = frames_of(100.0, 1)[0]
    cells = np.array([[1], [10**6]], np.int64)
    pipeline = PIPELINE.with_settings(fs.Settings("brightest", keep_brightest=9))
    path = FramePath(pipeline, [frame], Progress(cells, 0, 1))
    path.warm_up()
    assert path.measure(1, 0)
    before = path.slopes.vector.copy()
    path.set_dark(UNLIT, 1)
    assert path.measure(1, 0)
    assert np.array_equal(path.slopes.flags != 0, UNLIT)
    assert np.array_equal(path.slopes.vector, np.where(np.tile(UNLIT, 2), 0.0, before))
    assert np.isinf(path.slopes.standard_error_x[UNLIT]).all()
    path.set_dark(np.zeros(N, np.bool_), 2)
    assert path.measure(1, 0)
    assert np.array_equal(path.slopes.vector, before)


def test_small_windows_are_not_followed() -> None:
    layout = fs.Layout.grid((4, 4), pixels=2)
    follower = DarkFollower(fs.SlopePipeline(layout, fs.Settings("centroid")))
    for _ in range(9 * EVERY):
        follower.take(np.zeros((1, 8, 8), np.float32))
    assert not follower.look()


def test_the_mean_is_that_of_all_frames_and_then_of_the_latest() -> None:
    """Each frame then counts 1 - 1 / T as much as the next, with a time constant of T = 120 frames."""
    seen: list[MeanFlux] = []
    pipeline: Any = SimpleNamespace(settings=fs.Settings("map"))

    def with_flux(light: MeanFlux) -> Any:
        seen.append(light)
        return pipeline

    pipeline.with_flux = with_flux
    live: Any = SimpleNamespace(running=SimpleNamespace(layout=range(2), pipelines=[pipeline]))
    follower = FluxFollower(live, 120.0)
    flux = np.random.default_rng(1).uniform(50.0, 150.0, (300, 2)).astype(np.float32)
    for frame in flux[:99]:
        follower.take(frame)
    assert (follower.step(), seen) == (False, [])  # too few
    for frame in flux[99:120]:
        follower.take(frame)
    follower.take(np.array([np.nan, np.inf], np.float32))
    assert not follower.step()
    np.testing.assert_allclose(seen[-1].flux_e, flux[:120].mean(axis=0))
    for frame in flux[120:]:
        follower.take(frame)
    follower.step()
    left = (1 - 1 / 120) ** np.arange(180)[::-1]
    expected = flux[120:].T @ left / 120 + flux[:120].mean(axis=0) * (1 - 1 / 120) ** 180
    np.testing.assert_allclose(seen[-1].flux_e, expected)
    assert seen[-1].time_constant_frames == pytest.approx(120.0)
    pipeline.settings = fs.Settings("brightest")  # which does not use the flux
    assert (follower.step(), len(seen)) == (False, 2)
