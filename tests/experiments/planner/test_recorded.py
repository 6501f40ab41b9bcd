from typing import Any

import numpy as np
import pytest
from tests.experiments.planner_cases import QUICK
from tests.refusals import refused
from tests.shared_data import shared_file

from faintspot.experiments import question_from_frames, tune
from faintspot.experiments.planner.promise import frames_to_check
from faintspot.experiments.planner.text import UNCHECKED, recommendation
from faintspot.io.frames import read_array
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames

LAYOUT, WIDE = Layout.grid((6, 6), pixels=12), Layout.grid((6, 6), pixels=20)
CAMERA = Detector(read_noise_e=4.0, gain_e_per_adu=0.5, offset_adu=100.0)


def recorded(n_frames: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Return frames of a static field and darks."""
    rng = np.random.default_rng(4)
    positions = rng.uniform(-0.6, 0.6, (len(LAYOUT), 2))
    frames, _ = sensor_frames(LAYOUT, n_frames, flux_e=3000.0, positions=positions, detector=CAMERA, rng=rng)
    return frames, CAMERA.expose(np.zeros((20, *LAYOUT.frame_shape)), rng)


@pytest.mark.slow
def test_camera_flux_and_spot_are_measured() -> None:
    """The learnt PSF is used."""
    frames, darks = recorded()
    question = question_from_frames(frames, darks, layout=LAYOUT)
    assert question.gain_e_per_adu == pytest.approx(0.5, rel=0.05)  # 30 frames of 36 spots
    assert question.read_noise_e == pytest.approx(4.0, rel=0.06)  # as the gain
    assert question.star_flux_e == pytest.approx(3000.0, rel=0.06)  # spots off the middle lose a little
    assert question.spots.fwhm_px == pytest.approx(1.77, rel=0.1)
    assert any("PSF learnt" in fact for fact in question.recorded.facts)
    answer = tune(question, **QUICK)
    assert answer["ml"].method.psf is question.psf
    assert answer["ml"].settings.weight_floor == 1e-3


def test_what_is_given_is_not_measured() -> None:
    """Wrong values are refused before anything is measured; a single frame does not tell the gain."""
    frames, darks = recorded(2)
    given: dict[str, Any] = {"gain_e_per_adu": 0.5, "read_noise_e": 4.0, "fwhm_px": 1.8, "flux_e": 50.0}
    question = question_from_frames(frames[0], layout=LAYOUT, **given)
    assert (question.read_noise_e, question.spots.fwhm_px, question.star_flux_e) == (4.0, 1.8, 50.0)
    assert question.psf is None
    wrong: list[tuple[dict[str, Any], tuple[str, ...]]] = [
        ({"flux_e": float("nan")}, ("flux_e", "NaN")),
        ({"budget": "3furlongs"}, ("budget", "furlongs")),
        ({"gain_e_per_adu": 1e6}, ("recording", "gain_e_per_adu", "1e+09")),
    ]
    for values, words in wrong:
        with refused(*words):
            question_from_frames(frames, layout=LAYOUT, **values)
    with refused("gain_e_per_adu"):
        question_from_frames(frames[0], layout=LAYOUT)
    with refused("darks"):
        question_from_frames(frames[0], darks[:, :10], layout=LAYOUT)


def bright_frames() -> np.ndarray:
    """Return 8-bit frames of bright spots that move, with noise of 1 ADU and little photon noise."""
    rng = np.random.default_rng(1)
    v, u = np.indices(WIDE.frame_shape)
    frames = np.zeros((60, *WIDE.frame_shape))
    for frame in frames:
        for x, y in WIDE.centres + rng.normal(0.0, 0.7, WIDE.centres.shape):
            frame += 230 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.5**2))
    frames = rng.poisson(1500 * frames) / 1500 + rng.normal(2.0, 1.0, frames.shape)
    return np.clip(frames, 0, 255).round().astype(np.uint8)


@pytest.mark.slow
def test_bright_frames_with_little_photon_noise_have_an_answer() -> None:
    question = question_from_frames(bright_frames(), layout=WIDE)
    assert question.subject == "recording"
    assert question.star_flux_e == pytest.approx(1.36e7, rel=0.4)  # the gain is known to 15 %
    noise_adu = question.read_noise_e / question.gain_e_per_adu
    assert noise_adu == pytest.approx(np.sqrt(1 + 1 / 12), rel=0.1)
    answer = tune(question, realisations=256, steps=1)
    assert answer.magnitude_label == "magnitudes fainter than the recording"
    assert answer.promise is not None
    assert not answer.promise.contradicted
    assert answer.best.statistics.error.value < 0.02


@pytest.mark.slow
def test_a_faint_recording_has_the_range_of_its_spots() -> None:
    rng = np.random.default_rng(3)
    layout, camera = Layout.grid((6, 6), pixels=16), Detector(read_noise_e=3.0, offset_adu=100.0)
    positions = rng.uniform(-0.5, 0.5, (len(layout), 2))
    frames, _ = sensor_frames(layout, 30, flux_e=30.0, positions=positions, detector=camera, rng=rng)
    known: dict[str, Any] = {"layout": layout, "gain_e_per_adu": 1.0, "read_noise_e": 3.0, "fwhm_px": 1.77}
    question = question_from_frames(frames, **known)
    assert question.spots.search_range_px == 1.0  # 7.9 where noise is taken for spots
    assert question.star_flux_e == pytest.approx(30.0, rel=0.15)
    dark = question_from_frames(camera.expose(np.zeros(frames.shape), rng), **known, flux_e=30.0)
    assert dark.search_range_px == 1.0
    assert any("the flux is too low" in fact for fact in dark.recorded.facts)


@pytest.mark.slow
def test_a_single_frame_is_not_checked() -> None:
    frames, _ = recorded(1)
    known: dict[str, Any] = {"layout": LAYOUT, "gain_e_per_adu": 0.5, "read_noise_e": 4.0, "fwhm_px": 1.77}
    answer = tune(question_from_frames(frames, **known), **QUICK)
    assert answer.promise is None
    assert any(line.startswith(UNCHECKED) for line in recommendation(answer))


def test_only_so_many_frames_are_used_as_are_needed() -> None:
    layout = Layout.grid((40, 40), pixels=16)
    assert frames_to_check(layout) == 8
    assert frames_to_check(Layout.grid((2, 2), pixels=64)) == 256
    assert frames_to_check(Layout.grid((2, 2), pixels=16)) == 1024


@pytest.mark.slow
def test_flux_that_differs_between_subapertures_is_simulated_so() -> None:
    rng = np.random.default_rng(6)
    flux = np.where(np.arange(36) % 2, 500.0, 1500.0)
    positions = rng.uniform(-0.6, 0.6, (12, 36, 2))
    frames, _ = sensor_frames(LAYOUT, 12, flux_e=flux, positions=positions, detector=CAMERA, rng=rng)
    question = question_from_frames(frames, layout=LAYOUT, gain_e_per_adu=0.5)
    assert question.star_flux_e == pytest.approx(1000.0, rel=0.03)
    assert question.spots.relative_flux is not None
    np.testing.assert_allclose(question.spots.relative_flux, flux / 1000.0, rtol=0.06)  # 6 frames, 2 % each


@pytest.mark.slow
def test_unreliable_gain_is_not_used() -> None:
    frames = read_array(f"{shared_file('data/ciao_bench_60x224x224.npz')}:frames")[:8]  # as all 60 do
    question = question_from_frames(frames, gain_e_per_adu=2.0, flux_e=200.0)
    assert question.layout is not None
    assert len(question.layout) == 49  # those that the frame's edge does not cut
    assert question.spots.fwhm_px == pytest.approx(3.7, abs=0.2)
    with refused("gain_e_per_adu", "disagree"):
        question_from_frames(frames, layout=question.layout)


@pytest.mark.slow
def test_dark_subapertures_are_left_out_of_the_question_but_not_of_the_layout() -> None:
    lit = np.arange(36) != 7
    frames, _ = sensor_frames(LAYOUT, 12, flux_e=1000.0 * lit, detector=CAMERA, rng=np.random.default_rng(7))
    question = question_from_frames(frames, layout=LAYOUT, gain_e_per_adu=0.5)
    assert "left out 1 of 36 sub-apertures: dark" in question.recorded.facts
    assert question.star_flux_e == pytest.approx(1000.0, rel=0.03)
    assert question.layout == LAYOUT[lit]
    assert question.whole_layout == LAYOUT
