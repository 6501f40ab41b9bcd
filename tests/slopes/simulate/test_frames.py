"""Stacks of sub-apertures and whole sensor frames: truth, light, reproducibility, reference errors."""

from functools import partial
from typing import Any

import numpy as np
from tests.refusals import assert_each_refused

from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames, spots, subapertures
from faintspot.slopes.spots.psf import PSF

QUIET = Detector(0.0)
CORNERS = np.array([[0, 0], [2, 10], [12, 1]])
SQUARE, FLAT = (Layout((20, 24), window, CORNERS) for window in ((8, 8), (8, 6)))


def spots_as_seen(positions: Any, *, flux_e: Any, shape: tuple[int, int] = (16, 16), **spot: Any) -> Any:
    """Noiseless images whose flux counts what a centred spot leaves within its image."""
    centred = spots([[0.0, 0.0]], shape=shape, **spot)[0].sum()
    return spots(positions, shape=shape, flux_e=np.asarray(flux_e) / centred, **spot)


def test_subapertures_are_spots_seen_by_the_detector() -> None:
    images, truth = subapertures(5000, flux_e=80.0, size=1.5, rng=np.random.default_rng(1), detector=QUIET)
    assert images.shape == (5000, 16, 16)
    assert images.dtype == np.float32
    assert truth.shape == (5000, 2)
    assert truth.dtype == np.float64
    # Poisson sums: 4.9 standard errors, a false alarm in 1e6.
    expected = spots_as_seen(truth, flux_e=80.0, size=1.5).sum()
    assert abs(images.sum(dtype=np.float64) - expected) <= 4.9 * np.sqrt(expected)


def test_positions_are_uniform_in_their_range() -> None:
    _, truth = subapertures(20000, shape=(4, 4), position_range_px=3.0, rng=np.random.default_rng(2))
    assert np.all(np.abs(truth) <= 3)
    # Mean 0 and variance 3, 4.9 standard errors (variance of x^2: 81 / 5 - 9 = 7.2).
    assert np.all(np.abs(truth.mean(axis=0)) <= 4.9 * np.sqrt(3 / 20000))
    assert np.all(np.abs(np.square(truth).mean(axis=0) - 3) <= 4.9 * np.sqrt(7.2 / 20000))
    assert np.all(subapertures(3, position_range_px=0.0)[1] == 0)


def test_given_positions_come_back_as_truth() -> None:
    given = np.array([[0.5, -3.0], [2.0, 1.0]])
    images, truth = subapertures(
        2, positions=given, flux_e=[1e6, 4e6], detector=QUIET, rng=np.random.default_rng(11)
    )
    np.testing.assert_array_equal(truth, given)
    truth[:] = 0
    assert given[0, 1] == -3
    # 1e6 electrons, peak pixel 2e5: Poisson noise is 5 * sqrt(2e5) at most.
    mean_e = spots_as_seen(given, flux_e=[1e6, 4e6])
    assert np.all(np.abs(images - mean_e) <= 6 * np.sqrt(mean_e) + 20)


def test_images_are_photo_electrons_with_background_still_in() -> None:
    camera = Detector(
        2.0, background_e=3.0, dark_e=1.0, em_gain=50.0, gain_e_per_adu=4.0, offset_adu=200, bits=16
    )
    images, _ = subapertures(2000, flux_e=0.0, detector=camera, rng=np.random.default_rng(3))
    # Mean of 512,000 pixels with variance 2 * 4 e-^2: 4.9 standard errors.
    assert abs(images.mean(dtype=np.float64) - 4.0) <= 4.9 * np.sqrt(8.01 / images.size)


def test_seeds_and_detectors() -> None:
    first = subapertures(50, rng=np.random.default_rng(4))
    again = subapertures(50, rng=np.random.default_rng(4))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    noisy = subapertures(50, detector=Detector(3.0, background_e=5.0), rng=np.random.default_rng(4))
    np.testing.assert_array_equal(first[1], noisy[1])
    rng = np.random.default_rng(4)
    subapertures(50, rng=rng)
    assert not np.array_equal(subapertures(50, rng=rng)[1], first[1])
    assert not np.array_equal(subapertures(50)[1], subapertures(50)[1])


def test_many_subapertures_are_made_in_blocks() -> None:
    # 1500 x 40 x 40 pixels are more than one block; parameters must follow their sub-aperture.
    flux = np.arange(1500) * 100.0
    images, truth = subapertures(
        1500, shape=(40, 40), flux_e=flux, detector=QUIET, rng=np.random.default_rng(12)
    )
    mean_e = spots_as_seen(truth, shape=(40, 40), flux_e=flux).sum(axis=(1, 2))
    # 1500 sums at 6 standard errors: a false alarm in 3e6.
    assert np.all(np.abs(images.sum(axis=(1, 2), dtype=np.float64) - mean_e) <= 6 * np.sqrt(mean_e) + 20)


def test_sensor_frames_hold_each_spot_in_its_window() -> None:
    positions = np.array([[0.5, -0.5], [-1.0, 0.0], [2.0, 1.5]])
    frames, truth = sensor_frames(
        FLAT, 400, positions=positions, flux_e=[100.0, 0.0, 50.0], detector=QUIET,
        rng=np.random.default_rng(5),
    )  # fmt: skip
    assert frames.shape == (400, 20, 24)
    assert truth.shape == (400, 3, 2)
    np.testing.assert_array_equal(truth[17], positions)
    expected = np.zeros((20, 24))
    for (row, column), image in zip(
        CORNERS, spots_as_seen(positions, shape=(8, 6), flux_e=[100.0, 0.0, 50.0]), strict=True
    ):
        expected[row : row + 8, column : column + 6] += image
    assert np.all(frames[:, expected == 0] == 0)
    # 96 pixels, Poisson means over 400 frames; 7 standard errors as faint pixels are not Gaussian.
    assert np.all(np.abs(frames.mean(axis=0) - expected) <= 7 * np.sqrt(expected / 400) + 1e-6)


def test_sensor_frames_draw_new_positions_in_each_frame() -> None:
    frames, truth = sensor_frames(SQUARE, 30, position_range_px=2.0, rng=np.random.default_rng(6))
    assert np.unique(truth).size == truth.size
    assert np.abs(truth).max() <= 2
    assert frames.dtype == np.float32
    again = sensor_frames(SQUARE, 30, position_range_px=2.0, rng=np.random.default_rng(6))
    np.testing.assert_array_equal(frames, again[0])
    moving = np.random.default_rng(0).uniform(-1, 1, (30, 3, 2))
    _, truth = sensor_frames(SQUARE, 30, positions=moving)
    np.testing.assert_array_equal(truth, moving)


def test_sensor_frames_are_the_detectors_adu() -> None:
    camera = Detector(1.0, offset_adu=500.0, bits=12, hot_pixels=[(19, 23, 1e6)])
    frames, _ = sensor_frames(SQUARE, 3, detector=camera, rng=np.random.default_rng(7))
    assert frames.dtype == np.uint16
    assert np.all(frames[:, 19, 23] == 4095)
    assert np.median(frames) == 500


def test_many_frames_are_made_in_blocks() -> None:
    # 600 x 64 x 64 pixels are more than one block.
    frames, truth = sensor_frames(
        Layout((64, 64), (16, 16), np.array([[10, 20]])),
        600,
        flux_e=1e4,
        detector=QUIET,
        rng=np.random.default_rng(13),
    )
    total = frames[:, 10:26, 20:36].sum(axis=(1, 2), dtype=np.float64)
    expected = spots_as_seen(truth[:, 0], flux_e=1e4).sum(axis=(1, 2))
    assert np.all(np.abs(total - expected) <= 6 * np.sqrt(expected))
    assert frames.sum(dtype=np.float64) == total.sum()


def test_bad_subapertures_are_named_in_one_line() -> None:
    assert_each_refused(
        partial(subapertures, 3),
        flux_e=[-1, [1, 2]],
        positions=[[[0, 0]], [0, 0], np.full((3, 2), np.nan)],
        position_range_px=[-1],
        profile=["disc"],
        shape=[(4, 4, 4)],
        detector=["ccd"],
        rng=[np.random],
    )
    assert_each_refused(subapertures, n=[0, 2.5])


def test_bad_sensors_are_named_in_one_line() -> None:
    assert_each_refused(
        partial(sensor_frames, layout=SQUARE, n_frames=4),
        n_frames=[0],
        positions=[np.zeros((2, 2)), np.zeros((2, 3, 2))],
        size=[np.nan],
        detector=["ccd"],
    )


def test_frames_of_psfs_hold_their_images() -> None:
    psf = PSF.analytic("gaussian", elongation=[1.0, 2.0, 3.0], angle_deg=[0.0, 20.0, 70.0], index=[2, 0, 1])
    frames, truth = sensor_frames(
        FLAT, 300, flux_e=100.0, psf=psf, detector=QUIET, rng=np.random.default_rng(6)
    )
    for corner, plane, positions in zip(CORNERS, (2, 0, 1), truth.swapaxes(0, 1), strict=True):
        seen = frames[:, corner[0] : corner[0] + 8, corner[1] : corner[1] + 6].mean(axis=0)
        centred = psf.images([[0.0, 0.0]], (8, 6), which=plane).sum()
        expected = psf.images(positions, (8, 6), 100.0 / centred, which=plane).mean(axis=0)
        # 48 pixels of 300 frames: 5 standard errors.
        assert np.all(np.abs(seen - expected) <= 5 * np.sqrt(expected / 300) + 1e-3)


def test_jitter_moves_all_spots_together() -> None:
    options: dict[str, Any] = {"position_range_px": 0.0, "detector": QUIET}
    _, truth = sensor_frames(FLAT, 4000, jitter_px=0.3, rng=np.random.default_rng(7), **options)
    np.testing.assert_array_equal(truth, np.broadcast_to(truth[:, :1], truth.shape))
    # 4.9 standard errors of a standard deviation.
    assert np.all(np.abs(truth[:, 0].std(axis=0) - 0.3) <= 4.9 * 0.3 / np.sqrt(8000))
    still = sensor_frames(FLAT, 3, rng=np.random.default_rng(8))
    moved = sensor_frames(FLAT, 3, jitter_px=0.3, rng=np.random.default_rng(8))
    assert not np.array_equal(still[1], moved[1])
    np.testing.assert_allclose(np.ptp(moved[1] - still[1], axis=1), 0.0, atol=1e-12)
