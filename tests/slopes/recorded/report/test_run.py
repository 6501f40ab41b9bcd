"""Noise and centroid gain of methods from their slopes alone."""

from dataclasses import replace

import numpy as np
import pytest

from faintspot.slopes.recorded.report.run import NoiseComparison
from faintspot.slopes.recorded.statistics import MeasuredSlopes, frame_to_frame_noise, relative_gain


def moving(gain: float, noise: float, seed: int, n_frames: int = 400, n: int = 30) -> MeasuredSlopes:
    """Return slopes with a motion and aberrations that all seeds share, and noise of their own."""
    rng, common = np.random.default_rng(seed), np.random.default_rng(0)
    axes = []
    for _ in range(2):
        motion = 0.3 * np.sin(np.arange(n_frames) / 40 + common.uniform(0, 6))[:, None]
        spots = motion + 0.5 * common.normal(size=n)
        axes.append(gain * spots + noise * rng.normal(size=(n_frames, n)) + 0.1 * seed)
    shape = (n_frames, n)
    nothing = np.zeros(shape, int)
    return MeasuredSlopes(f"{seed}", axes[0], axes[1], np.ones(shape), nothing)


def test_noise_and_relative_gain_without_a_truth() -> None:
    """Noise is known to 1 % from 400 frames of 30 sub-apertures; the gain is not that of the noise."""
    sure, shrinking = moving(1.0, 0.2, 1), moving(0.6, 0.15, 2)
    noise = [np.median(frame_to_frame_noise(method, method.valid)) for method in (sure, shrinking)]
    np.testing.assert_allclose(noise, [0.2, 0.15], rtol=0.03)
    gain, error = relative_gain(shrinking, sure, sure.valid)
    assert abs(gain - 0.6) < 4 * error
    assert error < 0.02
    assert relative_gain(sure, sure, sure.valid) == (1.0, 0.0)


def test_error_of_a_relative_gain_is_its_scatter() -> None:
    """40 draws know the scatter to 11 %; three times that."""
    found = [
        relative_gain(moving(0.6, 0.15, seed, 100, 20), sure, sure.valid)
        for seed in range(2, 42)
        for sure in [moving(1.0, 0.2, seed + 100, 100, 20)]
    ]
    gains, errors = np.transpose(found)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(gains.std(), rel=0.33)


def test_noise_is_taken_from_frames_that_follow_each_other() -> None:
    method = moving(1.0, 0.2, 1)
    apart = replace(method, frames=2 * np.arange(method.n_frames))
    assert np.isnan(frame_to_frame_noise(apart, apart.valid)).all()
    # Every second pair of frames, between which the spots jump by 10 px.
    jumps = replace(method, frames=method.number + np.arange(method.n_frames) // 2)
    x = method.x + 10.0 * (np.arange(method.n_frames) // 2 % 2)[:, None]
    noise = frame_to_frame_noise(replace(jumps, x=x), method.valid)
    np.testing.assert_allclose(np.median(noise), 0.2, rtol=0.05)


def test_methods_are_ranked_at_equal_gain() -> None:
    """The one that shrinks all motion has less noise and jitter, and is the worse one."""
    methods = [moving(0.5, 0.15, 2), moving(1.0, 0.2, 1)]
    found = NoiseComparison.of(methods, [methods[0].valid] * 2)
    assert np.median(found.noise_px[0]) < np.median(found.noise_px[1])
    assert np.median(found.equal_noise(0)) == pytest.approx(0.3, rel=0.05)
    assert "'1' has the least noise" in found.verdict()
    assert len(found.warnings()) == 1
    alike = NoiseComparison.of([methods[1], moving(1.0, 0.2, 3)], [methods[0].valid] * 2)
    assert alike.warnings() == []
    assert "not differ" in alike.verdict()


def test_no_gain_is_claimed_where_nothing_moves() -> None:
    rng, flags = np.random.default_rng(1), np.zeros((50, 20), int)
    flux = np.ones((50, 20))
    methods = [
        MeasuredSlopes(name, rng.normal(size=(50, 20)), rng.normal(size=(50, 20)), flux, flags)
        for name in "ab"
    ]
    found = NoiseComparison.of(methods, [methods[0].valid] * 2)
    assert np.isnan(found.gains[0][0])
    assert found.warnings() == []
