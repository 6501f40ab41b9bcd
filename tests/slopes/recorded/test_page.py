"""The report page: complete, self-contained, and honest about what is missing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.slopes.recorded.recorded_cases import SETTINGS, Page, method_of, sensor, simulated, two_methods

from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.recorded.page import SlopesRun, method_numbers, slopes_report, warnings_in_words
from faintspot.slopes.recorded.pictures import Example
from faintspot.slopes.recorded.statistics import MeasuredSlopes, frame_to_frame_noise, relative_gain
from faintspot.slopes.sensor.layout import Layout

pytestmark = pytest.mark.usefixtures("undrawn_pictures")
SECTIONS = ["numbers", "frame", "flux", "slopes", "wavefront", "configuration"]


def page_of(of: Layout, frames: Any, true: Any = None) -> Page:
    methods, stages = two_methods(of, frames)
    return plain_page(SlopesRun(methods, of, Example(of, stages, 0, None if true is None else true[0]), true))


def plain_page(run: SlopesRun) -> Page:
    facts, configurations = {"Sources": "frames.fits"}, {"Configuration": "[settings]\nnoise_std = 0.3 # <b>"}
    return Page(slopes_report(run, title="A <test> & more", facts=facts, configurations=configurations))


def test_page_has_all_sections_pictures_and_numbers() -> None:
    layout = sensor()
    frames, truth = simulated(layout, 6)
    plain, page = page_of(layout, frames), page_of(layout, frames, truth)
    assert plain.ids == SECTIONS
    assert [tag for tag, _ in plain.tags].count("img") == 6
    method = two_methods(layout, frames)[0][0]
    slopes = method.slopes
    assert f"{np.median(slopes.flux[method.valid]):#.3g}".rstrip(".") + " e-" in page.text
    errors = (np.abs(slopes.x - truth[..., 0]) + np.abs(slopes.y - truth[..., 1])) / 2
    assert f"{errors.mean():#.4g} ±" in page.text
    assert "slope error R" not in plain.text


def test_numbers_are_those_of_known_noise() -> None:
    """Of 400 frames of spots that stay, with noise of 0.1 and 0.2 px: medians of 9 sub-apertures know it to
    2 %, from frame to frame to 3 %; three times that.
    """
    layout, rng = replace(sensor(), pixel_scale_arcsec=0.3), np.random.default_rng(5)
    truth = np.broadcast_to(rng.uniform(-1.0, 1.0, (9, 2)), (400, 9, 2))
    methods = []
    for name, noise_px in (("a", 0.1), ("b", 0.2)):
        x, y = (truth + noise_px * rng.standard_normal(truth.shape)).transpose(2, 0, 1)
        methods.append(method_of(name, x, y, error_px=noise_px))
    found: dict[str, Any] = method_numbers(SlopesRun(methods, layout, truth=truth), 0)
    assert found["noise"] == pytest.approx(0.1, rel=0.1)
    assert found["noise_arcsec"] == pytest.approx(0.3 * found["noise"])
    assert (found["jitter"], found["stated_error"]) == pytest.approx((0.1, 0.1), rel=0.07)
    assert found["error"].value == pytest.approx(0.1 * np.sqrt(2 / np.pi), rel=0.05)


def test_one_frame_says_that_there_is_no_jitter() -> None:
    layout = sensor()
    page = page_of(layout, simulated(layout, 1)[0])
    assert "one frame only" in page.text
    assert "jitter (px)" not in page.text
    assert page.ids == SECTIONS


def test_page_says_when_everything_is_invalid() -> None:
    layout = sensor()
    page = page_of(layout, np.full((3, *layout.frame_shape), np.nan, np.float32), np.zeros((3, 9, 2)))
    assert "No measurement is valid" in page.text
    assert "nan" not in page.text.lower().split()


def test_one_method_and_hexagonal_layout() -> None:
    corners = np.array([[0, 2], [0, 12], [9, 7]])
    layout = Layout((20, 22), (8, 8), corners, geometry="hexagonal", pitch_px=10.0)
    frames, _ = simulated(layout, 3)
    pipeline = SlopePipeline(layout, SETTINGS.replace(estimator="brightest"))
    text = plain_page(SlopesRun([MeasuredSlopes("no TV", pipeline(frames))], layout, "no frame")).text
    assert "hexagonal" in text
    assert "INFEASIBLE_STRENGTH" not in text
    assert "no frame" in text


def test_without_layout_the_page_says_so() -> None:
    layout = sensor()
    page = plain_page(SlopesRun(two_methods(layout, simulated(layout, 3)[0])[0], None))
    assert page.text.count("the layout of the sub-apertures is not known") == 2


def test_warnings_say_what_to_do_next() -> None:
    x = np.zeros((4, 5))
    flags = np.zeros((4, 5), np.uint8)
    flags[:, 0] = 1  # NO_FLUX
    flags[:, 1] = 8  # SATURATED
    flags[:, 2] = 32  # NOT_CONVERGED
    text = plain_page(SlopesRun([method_of("TV", x, x, 5.0, flags)], None)).text
    assert "20.0 % of the measurements had no flux" in text
    assert "20.0 % of the measurements were saturated" in text
    assert "raise max_iterations" in text
    assert "1 of 5 sub-apertures were never valid (no. 0)" in text
    assert "NO_FLUX 4 (20" in text


def moving(gain: float, noise: float, seed: int, n_frames: int = 400, n: int = 30) -> MeasuredSlopes:
    """Return slopes with a motion and aberrations that all seeds share, and noise of their own."""
    rng, common = np.random.default_rng(seed), np.random.default_rng(0)
    axes = []
    for _ in range(2):
        motion = 0.3 * np.sin(np.arange(n_frames) / 40 + common.uniform(0, 6))[:, None]
        spots = motion + 0.5 * common.normal(size=n)
        axes.append(gain * spots + noise * rng.normal(size=(n_frames, n)) + 0.1 * seed)
    return method_of(f"{seed}", axes[0], axes[1])


def test_noise_and_relative_gain_without_a_truth() -> None:
    """Noise is known to 1 % from 400 frames of 30 sub-apertures; the gain is not that of the noise."""
    sure, shrinking = moving(1.0, 0.2, 1), moving(0.6, 0.15, 2)
    noise = [np.median(frame_to_frame_noise(method, method.valid)) for method in (sure, shrinking)]
    np.testing.assert_allclose(noise, [0.2, 0.15], rtol=0.03)
    gain = relative_gain(shrinking, sure, sure.valid)
    assert abs(gain.value - 0.6) < 4 * gain.standard_error
    assert gain.standard_error < 0.02
    assert relative_gain(sure, sure, sure.valid).value == 1.0


def test_error_of_a_relative_gain_is_its_scatter() -> None:
    """40 draws know the scatter to 11 %; three times that."""
    found = [
        relative_gain(moving(0.6, 0.15, seed, 100, 20), sure, sure.valid)
        for seed in range(2, 42)
        for sure in [moving(1.0, 0.2, seed + 100, 100, 20)]
    ]
    errors = np.array([gain.standard_error for gain in found])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(np.std([gain.value for gain in found]), rel=0.33)


def test_noise_is_taken_from_frames_that_follow_each_other() -> None:
    method = moving(1.0, 0.2, 1)
    apart = replace(method, frames=2 * np.arange(method.n_frames))
    assert np.isnan(frame_to_frame_noise(apart, apart.valid)).all()
    # Every second pair of frames, between which the spots jump by 10 px.
    jumps = replace(method, frames=method.number + np.arange(method.n_frames) // 2)
    x = method.slopes.x + 10.0 * (np.arange(method.n_frames) // 2 % 2)[:, None]
    noise = frame_to_frame_noise(replace(jumps, slopes=replace(method.slopes, x=x)), method.valid)
    np.testing.assert_allclose(np.median(noise), 0.2, rtol=0.05)


def test_methods_are_ranked_at_equal_gain() -> None:
    """The one that shrinks all motion has less noise and jitter, and is the worse one."""
    methods = [moving(0.5, 0.15, 2), moving(1.0, 0.2, 1)]
    run = SlopesRun(methods, None)
    assert np.median(run.noise_px[0]) < np.median(run.noise_px[1])
    assert np.median(run.equal_noise_px(0)) == pytest.approx(0.3, rel=0.05)
    assert "'1' has the least noise" in run.verdict()
    assert len(warnings_in_words(run)) == 1
    alike = SlopesRun([methods[1], moving(1.0, 0.2, 3)], None)
    assert warnings_in_words(alike) == []
    assert "not differ" in alike.verdict()


def test_no_gain_is_claimed_where_nothing_moves() -> None:
    rng = np.random.default_rng(1)
    run = SlopesRun(
        [method_of(name, rng.normal(size=(50, 20)), rng.normal(size=(50, 20))) for name in "ab"], None
    )
    assert np.isnan(run.gains[0].value)
    assert warnings_in_words(run) == []
