"""Read noise and gain of simulated detectors whose values are known, and of a real camera."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import assert_each_refused

from faintspot.slopes.camera.photon_transfer import measure_detector
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames

CAMERA = Detector(5.0, gain_e_per_adu=2.0, offset_adu=100.0, bits=14)
MULTIPLYING = Detector(40.0, em_gain=100.0, gain_e_per_adu=20.0, offset_adu=200.0)
LAYOUT = Layout.grid((6, 6), pixels=16)


def recorded(
    detector: Detector, flux_e: float, *, movement_px: float = 0.0, seed: int = 1, n_frames: int = 40
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Frames of spots that jitter, and dark frames."""
    rng = np.random.default_rng(seed)
    still = rng.uniform(-1, 1, (len(LAYOUT), 2))
    positions = still + movement_px * rng.standard_normal((n_frames, len(LAYOUT), 2))
    frames, _ = sensor_frames(
        LAYOUT, n_frames, flux_e=flux_e, positions=positions, detector=detector, rng=rng
    )
    return frames, detector.expose(np.zeros((30, *LAYOUT.frame_shape)), rng)


@pytest.mark.parametrize("movement_px", [0.0, 0.05])
@pytest.mark.parametrize(("detector", "flux_e"), [(CAMERA, 5000.0), (MULTIPLYING, 300.0)])
def test_darks_and_frames_give_the_detector(detector: Detector, flux_e: float, movement_px: float) -> None:
    frames, darks = recorded(detector, flux_e, movement_px=movement_px)
    found = measure_detector(frames, darks, layout=LAYOUT, em_gain=detector.em_gain)
    assert found.reliable, found.notes
    # 9216 pixels and 30 frames: 0.2 % statistical; rounding to whole ADU adds 1/12 ADU^2 to 6.25 (0.7 %).
    expected = float(np.mean(detector.read_noise_e)) / detector.gain_e_per_adu
    rounding = 1 / 12 if detector.bits else 0.0
    assert found.read_noise_adu.value == pytest.approx(np.sqrt(expected**2 + rounding), rel=0.012)
    # Standard error 1.5 to 2 %, times 4.
    assert found.gain_e_per_adu.value == pytest.approx(detector.gain_e_per_adu, rel=0.08)
    assert found.gain_e_per_adu.standard_error < 0.03 * detector.gain_e_per_adu
    assert found.dark_level_adu.value == pytest.approx(detector.offset_adu, abs=0.05)
    assert found.read_noise_e.value == pytest.approx(float(np.mean(detector.read_noise_e)), rel=0.09)


@pytest.mark.slow
def test_the_stated_error_of_the_gain_is_the_scatter() -> None:
    found = [measure_detector(*recorded(CAMERA, 2000.0, seed=seed, n_frames=20)) for seed in range(8)]
    gains = np.array([measured.gain_e_per_adu.value for measured in found])
    errors = np.array([measured.gain_e_per_adu.standard_error for measured in found])
    # Eight values: chi-squared of 7 degrees of freedom is below 24.3 and above 0.6 in 99.8 % of cases.
    assert 0.6 < np.sum(np.square((gains - gains.mean()) / errors)) < 24.3
    assert abs(gains.mean() - 2.0) < 4 * errors.mean() / np.sqrt(8)


def test_stated_errors_in_the_dark_are_the_scatter() -> None:
    """40 draws know the scatter to 11 %; three times that."""
    found = [
        measure_detector(darks=CAMERA.expose(np.zeros((9, 24, 24)), np.random.default_rng(seed)))
        for seed in range(40)
    ]
    for name in ("read_noise_adu", "dark_level_adu"):
        values = np.array([getattr(each, name).value for each in found])
        errors = np.array([getattr(each, name).standard_error for each in found])
        assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(values.std(), rel=0.33)
    one = measure_detector(*recorded(CAMERA, 5000.0, n_frames=10), layout=LAYOUT)
    noise, gain = one.read_noise_adu, one.gain_e_per_adu
    parts = noise.standard_error / noise.value, gain.standard_error / gain.value
    assert one.read_noise_e.value == pytest.approx(noise.value * gain.value)
    assert one.read_noise_e.standard_error == pytest.approx(one.read_noise_e.value * np.hypot(*parts))


@pytest.mark.parametrize("frames", [2, 3])
def test_few_darks_give_the_read_noise(frames: int) -> None:
    """Of 9216 pixels: 1 % for two frames, whose median variance is .45 of the mean one."""
    darks = MULTIPLYING.expose(np.zeros((frames, *LAYOUT.frame_shape)), np.random.default_rng(1))
    assert measure_detector(darks=darks).read_noise_adu.value == pytest.approx(2.0, rel=0.04)


def test_without_darks_the_darkest_pixels_serve() -> None:
    frames, _ = recorded(CAMERA, 5000.0)
    found = measure_detector(frames, layout=LAYOUT)
    # The darkest of 9216 pixels lie by a few standard errors of a mean (0.4 ADU) below the level.
    assert found.dark_level_adu.value == pytest.approx(100.0, abs=2.0)
    assert found.read_noise_adu.value == pytest.approx(2.5, rel=0.05)
    assert found.gain_e_per_adu.value == pytest.approx(2.0, rel=0.08)
    known = measure_detector(frames, dark_level_adu=100.0)
    assert known.dark_level_adu.value == 100.0
    assert known.dark_level_adu.standard_error == 0.0
    assert "dark level: given" in known.notes


def test_frames_written_twice_are_left_out() -> None:
    frames, darks = recorded(CAMERA, 5000.0, n_frames=10)
    found = measure_detector(frames, darks, layout=LAYOUT)
    twice = measure_detector(np.repeat(frames, 2, axis=0), np.repeat(darks, 2, axis=0), layout=LAYOUT)
    assert twice.gain_e_per_adu == found.gain_e_per_adu
    assert twice.read_noise_adu == found.read_noise_adu
    assert any("10 of 20" in note for note in twice.notes)


def test_hot_pixels_and_a_drifting_level_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    hot = [(3, 5, 4000.0), (40, 41, 900.0), (70, 12, 20000.0)]
    camera = Detector(6.0, gain_e_per_adu=3.0, offset_adu=50.0, hot_pixels=hot)
    darks = camera.expose(np.zeros((20, 80, 80)), rng) + np.linspace(0, 4, 20)[:, None, None]
    found = measure_detector(darks=darks)
    # 6400 pixels, 20 frames: 0.3 % standard error.
    assert found.read_noise_adu.value == pytest.approx(2.0, rel=0.015)
    assert found.dark_level_adu.value == pytest.approx(52.0, abs=0.1)
    assert np.isnan(found.gain_e_per_adu.value)
    assert np.isnan(found.read_noise_e.value)
    assert found.reliable


def test_flickering_brightness_is_taken_out() -> None:
    rng = np.random.default_rng(4)
    y, x = np.indices((64, 64))
    flux = 100 + 800 * np.exp(-((x % 16 - 7.3) ** 2 + (y % 16 - 8.1) ** 2) / 18)
    flicker = 1 + 0.1 * rng.standard_normal((50, 1, 1))
    frames = CAMERA.expose(flux * flicker, rng)
    found = measure_detector(frames, dark_level_adu=100.0)
    # 10 % of 900 e- is 90 e-, three times the photon noise, were it left in.
    assert found.reliable, found.notes
    assert found.gain_e_per_adu.value == pytest.approx(2.0, rel=0.08)


@pytest.mark.parametrize(
    ("flux_e", "movement_px", "note"),
    [(5000.0, 0.3, "moves too much"), (5000.0, 1.0, "moves too much"), (2.0, 0.0, "more flux")],
)
def test_movement_and_flux_without_a_gain_are_said(flux_e: float, movement_px: float, note: str) -> None:
    found = measure_detector(*recorded(CAMERA, flux_e, movement_px=movement_px), layout=LAYOUT)
    assert not found.reliable
    assert note in found.notes[-1]
    assert found.read_noise_adu.value == pytest.approx(2.5, rel=0.02)


def test_saturation_is_said_and_a_range_avoids_it() -> None:
    rng = np.random.default_rng(5)
    flux = np.tile(np.linspace(50.0, 1500.0, 96), (96, 1))
    camera = Detector(5.0, gain_e_per_adu=2.0, offset_adu=100.0, full_well_e=1000.0)
    frames = camera.expose(np.broadcast_to(flux, (40, 96, 96)), rng)
    assert not measure_detector(frames, dark_level_adu=100.0).reliable
    found = measure_detector(frames, dark_level_adu=100.0, range_adu=(0.0, 400.0))
    assert found.reliable, found.notes
    assert found.gain_e_per_adu.value == pytest.approx(2.0, rel=0.04)


def test_constant_frames_give_no_nan() -> None:
    found = measure_detector(np.full((4, 32, 32), 7.0), np.zeros((4, 32, 32)))
    assert found.read_noise_adu.value == 0.0
    assert np.isnan(found.gain_e_per_adu.value)
    assert not found.reliable
    assert measure_detector(np.full((4, 32, 32), 7.0)).read_noise_adu.value == 0.0


def test_wrong_values_are_refused() -> None:
    frames = np.zeros((3, 20, 20))
    assert_each_refused(
        measure_detector, frames=[None, frames[:1], frames[0]], darks=[np.full_like(frames, np.nan)]
    )
    assert_each_refused(
        partial(measure_detector, frames=frames),
        darks=[np.zeros((3, 20, 21))],
        layout=[LAYOUT],
        em_gain=[0.5],
        range_adu=[(2.0, 1.0), (5.0, 9.0)],
        dark_level_adu=[np.inf],
    )
