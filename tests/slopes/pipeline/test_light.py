"""The running mean of the flux, and pipelines that are told it."""

from functools import partial

import numpy as np
from tests.refusals import assert_each_refused

import faintspot as fs
from faintspot.slopes.estimators.built_in.window import Window


def test_mean_of_all_frames_until_the_time_constant() -> None:
    frames = np.random.default_rng(1).normal(20.0, 5.0, (40, 7))
    flux = fs.MeanFlux(frames[0], time_constant_frames=100)
    for frame in frames[1:]:
        flux = flux.updated(frame)
    np.testing.assert_allclose(flux.flux_e, frames.mean(axis=0))
    np.testing.assert_allclose(fs.MeanFlux(frames).flux_e, frames.mean(axis=0))
    assert fs.MeanFlux(frames).frames == 40


def test_forgets_after_the_time_constant() -> None:
    flux = fs.MeanFlux(np.full(3, 100.0), time_constant_frames=50, frames=50)
    for _ in range(50):
        flux = flux.updated(np.zeros(3))
    np.testing.assert_allclose(flux.flux_e, 100.0 * (1 - 1 / 50) ** 50)


def test_is_a_value_and_skips_what_is_not_finite() -> None:
    flux = fs.MeanFlux(np.array([10.0, 20.0]))
    later = flux.updated(np.array([np.nan, 40.0]))
    assert flux.flux_e.tolist() == [10.0, 20.0]
    assert later.flux_e.tolist() == [10.0, 30.0]


def window_pipeline() -> fs.SlopePipeline:
    settings = fs.Settings(Window(window_fwhm_px=3.0), spot_fwhm_px=2.0)
    return fs.SlopePipeline(fs.Layout.grid((2, 3), pixels=8), settings, fs.Calibration(read_noise_e=1.0))


def test_slopes_are_divided_by_the_mean_flux() -> None:
    frame = np.random.default_rng(2).poisson(3.0, (16, 24))
    once = window_pipeline().with_flux(100.0)(frame)
    twice = window_pipeline().with_flux(200.0)(frame)
    # Flux counts in steps of 2 %.
    np.testing.assert_allclose(once.vector, 2 * twice.vector, rtol=0.03, atol=1e-6)


def test_the_same_pipeline_while_the_flux_is_steady() -> None:
    pipeline = window_pipeline().with_flux(100.0)
    assert pipeline.with_flux(fs.MeanFlux(np.full(6, 101.0))) is pipeline
    assert pipeline.with_flux(np.full(6, 110.0)) is not pipeline
    assert pipeline.with_flux(fs.MeanFlux(np.full(6, -3.0))).settings.flux_e.max() < 0.01


def test_what_is_refused() -> None:
    assert_each_refused(
        partial(fs.MeanFlux, [1.0]),
        time_constant_frames=[0.5],
        frames=[0.0],
    )
    assert_each_refused(fs.MeanFlux, flux_e=[[np.nan], [[[1.0]]]])
    assert_each_refused(fs.MeanFlux([1.0, 2.0]).updated, flux_e=[np.ones(3)])
    assert_each_refused(window_pipeline().with_flux, mean_flux=[np.ones(5)])
