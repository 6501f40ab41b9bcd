"""Fixed weights: their checks, their file, and the best linear estimate."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

import faintspot as fs
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.pipeline.images import measure_images
from faintspot.slopes.spots.shapes import spots

SIDE = 12
NOISE_E, FLUX_E = 3.0, 60.0


def spots_of_a_loop(n: int, seed: int, rms_px: float = 0.5) -> tuple[Any, Any]:
    """Spots that move as residual wavefronts move them."""
    truth = np.random.default_rng(seed).normal(0.0, rms_px, (n, 2))
    return spots(truth, shape=(SIDE, SIDE), profile="gaussian", size=1.0), truth


def errors(settings: fs.Settings, seed: int = 5, **parts: Any) -> tuple[float, float]:
    """Rms error at the best linear scale, so that shrinking wins nothing, and the gain."""
    clean, truth = spots_of_a_loop(20_000, seed)
    noisy = fs.slopes.simulate.Detector(NOISE_E).expose(FLUX_E * clean, np.random.default_rng(seed + 1))
    found = measure_images(noisy, settings, calibration=fs.Calibration(read_noise_e=NOISE_E), **parts)
    slopes = np.stack([found.x, found.y], axis=1)
    assert found.valid.all()
    gain = float((slopes * truth).sum() / (truth**2).sum())
    best = float((slopes * truth).sum() / (slopes**2).sum())
    return float(np.sqrt(np.mean((best * slopes - truth) ** 2))), gain


def window(fwhm_px: float) -> fs.Settings:
    return fs.Settings(Window(window_fwhm_px=fwhm_px), spot_fwhm_px=2.0, flux_e=FLUX_E)


@pytest.fixture(scope="module")
def learnt() -> fs.FixedWeights:
    clean, truth = spots_of_a_loop(20_000, 1)
    return fs.FixedWeights.best_linear(clean, truth, flux_e=FLUX_E, read_noise_e=NOISE_E)


@pytest.mark.slow
def test_the_best_linear_weights_beat_every_gaussian_window(learnt: fs.FixedWeights) -> None:
    """Their mean square error is the least of all linear ones; 1 % for what the samples differ."""
    best, gain = errors(window(2.0), weights=learnt)
    gaussian = [errors(window(fwhm))[0] for fwhm in (1.5, 2.0, 2.5, 3.0, 4.0)]
    assert best < 1.01 * min(gaussian)
    assert gain == pytest.approx(1.0, abs=0.02)  # 20,000 spots of .5 px with errors of about 1 px: +-.01


def test_noisy_pixels_get_smaller_weights() -> None:
    """With a map the weights are those of a number where it is constant, and small in a noisy pixel."""
    clean, truth = spots_of_a_loop(2000, 8)
    noise = np.full((SIDE, SIDE), NOISE_E)

    def best(read_noise_e: Any) -> fs.FixedWeights:
        return fs.FixedWeights.best_linear(clean, truth, flux_e=FLUX_E, read_noise_e=read_noise_e)

    np.testing.assert_allclose(best(noise).x, best(NOISE_E).x, rtol=1e-9)
    row, column = np.argwhere(np.abs(best(NOISE_E).x[0]) == np.abs(best(NOISE_E).x[0]).max())[0]
    noise[row, column] = 100 * NOISE_E
    assert np.abs(best(noise).x[0, row, column]) < 0.01 * np.abs(best(NOISE_E).x[0, row, column])
    with refused("read_noise_e", f"({SIDE}, {SIDE})"):
        best(np.ones(3))


def test_weights_equal_a_sum_over_the_pixels(learnt: fs.FixedWeights) -> None:
    clean, _ = spots_of_a_loop(50, 9)
    images = (FLUX_E * clean).astype(np.float32)
    found = measure_images(
        images, window(2.0), calibration=fs.Calibration(read_noise_e=NOISE_E), weights=learnt
    )
    expected = np.einsum("yx,nyx->n", learnt.x[0], images / FLUX_E - learnt.mean_spot[0])
    np.testing.assert_allclose(found.x, expected, atol=1e-5)  # float32 sums of 144 pixels


def test_stated_errors_are_those_of_the_slopes(learnt: fs.FixedWeights) -> None:
    """Of a spot at the mean position, for which they are meant."""
    clean = np.repeat(spots(np.zeros((1, 2)), shape=(SIDE, SIDE), profile="gaussian", size=1.0), 6000, 0)
    noisy = fs.slopes.simulate.Detector(NOISE_E).expose(FLUX_E * clean, np.random.default_rng(2))
    found = measure_images(
        noisy, window(2.0), calibration=fs.Calibration(read_noise_e=NOISE_E), weights=learnt
    )
    # 6000 slopes: 0.9 %; the mean spot of the training is wider than one spot.
    assert found.x.std() == pytest.approx(float(found.standard_error_x[0]), rel=0.04)


def test_without_known_flux_the_frame_says_it() -> None:
    clean, _ = spots_of_a_loop(9, 3)
    images = (1e4 * clean).astype(np.float32)
    layout, settings = fs.Layout.grid((9, 1), pixels=SIDE), window(2.5).replace(flux_e=None)
    pipeline = fs.SlopePipeline(layout, settings, fs.Calibration(read_noise_e=1.0))
    frame = images.reshape(layout.frame_shape)
    np.testing.assert_allclose(pipeline(frame).vector, pipeline(3 * frame).vector, atol=1e-5)


def test_spots_without_flux_are_flagged() -> None:
    settings = window(2.0).replace(flux_e=np.array([60.0, 1e-6]))
    clean, _ = spots_of_a_loop(2, 3)
    found = measure_images(FLUX_E * clean, settings, calibration=fs.Calibration(read_noise_e=1.0))
    assert found.valid.tolist() == [True, False]


@pytest.mark.parametrize("fwhm_px", [1.5, 30.0])
def test_dark_flat_gain_and_bad_pixels(fwhm_px: float) -> None:
    """Calibration is part of the weights; a bad pixel that counts is filled as for all others."""
    rng = np.random.default_rng(8)
    layout = fs.Layout.grid((4, 5), pixels=16)
    adu = rng.poisson(40.0, layout.frame_shape) + 1000.0
    dark, flat = rng.normal(1000.0, 3.0, adu.shape), rng.uniform(0.8, 1.2, adu.shape)
    bad = np.zeros(adu.shape, bool)
    bad[7, 8] = bad[16 + 1, 16 + 1] = True  # at a spot, and where a narrow window does not look
    calibration = fs.Calibration(dark, flat, 1.7, bad_pixels=bad, read_noise_e=2.0)
    found = fs.SlopePipeline(layout, window(fwhm_px), calibration)(adu)
    filled = layout.images(np.where(bad, np.nan, (adu - dark) * 1.7 / flat))
    clean = fs.SlopePipeline(
        fs.Layout.grid((20, 1), pixels=16), window(fwhm_px), fs.Calibration(read_noise_e=2.0)
    )(filled.reshape(-1, 16))
    np.testing.assert_allclose(found.vector, clean.vector, atol=2e-4)  # float32 sums of 1000 ADU
    assert np.flatnonzero(found.bad_pixels).tolist() == ([0] if fwhm_px < 2 else [0, 6])


def test_saturated_pixels_that_count() -> None:
    layout = fs.Layout.grid((1, 2), pixels=16)
    frame = np.full(layout.frame_shape, 10, np.float32)
    frame[8, 8] = frame[0, 16] = 65535
    calibration = fs.Calibration(read_noise_e=2.0, saturation_adu=65535.0)
    flags = fs.SlopePipeline(layout, window(2.0), calibration)(frame).flags
    assert ((flags & fs.SubapertureFlag.SATURATED) != 0).tolist() == [True, False]


def test_quad_cells_are_sums_of_four_pixels() -> None:
    """Sums of four pixels, with the gain of the spot."""
    cell = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    weights = fs.FixedWeights(0.5 * cell, 0.5 * cell.T, np.full((2, 2), 0.25))
    images = np.array([[[1.0, 3.0], [1.0, 3.0]], [[4.0, 4.0], [0.0, 0.0]]])
    found = measure_images(
        images, fs.Settings("window"), calibration=fs.Calibration(read_noise_e=0.1), weights=weights
    )
    np.testing.assert_allclose(found.vector, [0.25, 0.0, 0.0, -0.5], atol=1e-6)


def test_files_give_back_the_weights(tmp_path: Path, learnt: fs.FixedWeights) -> None:
    path = tmp_path / "weights.npz"
    learnt.save(path)
    again = fs.FixedWeights.load(path)
    for name in ("x", "y", "mean_spot", "flux"):
        np.testing.assert_array_equal(getattr(again, name), getattr(learnt, name))


def test_what_is_refused(learnt: fs.FixedWeights) -> None:
    maps = {"x": np.ones((4, 4)), "y": np.ones((4, 4)), "mean_spot": np.full((4, 4), 1 / 16)}
    assert_each_refused(
        partial(fs.FixedWeights, **maps),
        x=[np.zeros((2, 2, 2, 2)), np.full((4, 4), np.nan), np.full((4, 4), 1e30)],
        y=[np.zeros((3, 3))],
        mean_spot=[np.zeros((4, 4))],
        flux=[np.ones((5, 4))],
        index=[[[0]], [1]],
    )
    matched = partial(fs.FixedWeights.matched, ELONGATED, (SIDE, SIDE), flux_e=10.0, read_noise_e=1.0)
    assert_each_refused(matched, flux_e=[0.0, [1.0] * 3], read_noise_e=[-1.0])
    assert_each_refused(partial(fs.FixedWeights.shaped, ELONGATED, (SIDE, SIDE)), power=[-1.0])
    with refused("psf"):
        fs.FixedWeights.shaped(ELONGATED, (1, 1))
    layout = fs.Layout.grid((2, 2), pixels=8)
    with refused("windows of 8 x 8 px", "got 12 x 12"):
        fs.SlopePipeline(layout, fs.Settings("window"), weights=learnt)
    with refused("settings.flux_e"):
        fs.SlopePipeline(layout, fs.Settings(Window(normalisation="mean"), spot_fwhm_px=2.0))


ELONGATED = fs.PSF.analytic(
    "gaussian", size=[1.0, 1.2], elongation=[2.0, 2.5], angle_deg=[30.0, 100.0], index=[0, 1]
)


def response(weights: fs.FixedWeights, kind: int, move: tuple[float, float]) -> Any:
    """Slopes in x and y, and flux, of a spot of 1 e- that moved."""
    image = ELONGATED.images([move], (SIDE, SIDE), which=kind)[0]
    away = image - weights.mean_spot[kind]
    return np.array(
        [(weights.x[kind] * away).sum(), (weights.y[kind] * away).sum(), (weights.flux[kind] * image).sum()]
    )


@pytest.mark.parametrize(
    "weights",
    [
        fs.FixedWeights.matched(ELONGATED, (SIDE, SIDE), flux_e=FLUX_E, read_noise_e=NOISE_E),
        fs.FixedWeights.shaped(ELONGATED, (SIDE, SIDE), power=0.7),
    ],
)
def test_weights_of_rotated_spots_are_unbiased_on_both_axes(weights: fs.FixedWeights) -> None:
    for kind in (0, 1):
        found = response(weights, kind, (0.02, -0.03))
        # The image is linear in small moves.
        np.testing.assert_allclose(found, [0.02, -0.03, 1.0], atol=1e-3)


def test_the_matched_filter_reaches_the_bound_and_shaped_weights_do_not() -> None:
    noise = fs.slopes.simulate.Detector(NOISE_E)
    flux = FLUX_E / ELONGATED.images(np.zeros((2, 2)), (SIDE, SIDE), which=[0, 1]).sum(axis=(1, 2))
    bound = fs.cramer_rao_covariance(FLUX_E, ELONGATED, (SIDE, SIDE), detector=noise, noise="gaussian")
    variances = []
    for weights in (
        fs.FixedWeights.matched(ELONGATED, (SIDE, SIDE), flux_e=flux, read_noise_e=NOISE_E),
        fs.FixedWeights.shaped(ELONGATED, (SIDE, SIDE)),
    ):
        pixels = NOISE_E**2 + flux[:, None, None] * weights.mean_spot
        maps = np.stack([weights.x, weights.y], axis=1)
        variances.append(np.einsum("kaij,kbij,kij->kab", maps, maps, pixels) / flux[:, None, None] ** 2)
    np.testing.assert_allclose(variances[0], bound, rtol=2e-3, atol=1e-5)
    assert np.all(np.diagonal(variances[1], axis1=1, axis2=2) > np.diagonal(bound, axis1=1, axis2=2))


def test_weights_of_psfs_work_in_a_pipeline_per_subaperture() -> None:
    weights = fs.FixedWeights.matched(ELONGATED, (SIDE, SIDE), flux_e=1e4, read_noise_e=NOISE_E)
    truth = np.array([[0.05, -0.1], [-0.08, 0.02]])
    frame = np.concatenate(list(ELONGATED.images(truth, (SIDE, SIDE), 1e4, which=[0, 1])), axis=1)
    layout = fs.Layout.grid((1, 2), pixels=SIDE)
    slopes = fs.SlopePipeline(layout, fs.Settings("window", flux_e=1e4), weights=weights)(frame)
    # Moves of a tenth of a pixel are linear to 1 %.
    np.testing.assert_allclose(np.stack([slopes.x, slopes.y], axis=1), truth, atol=2e-3)
