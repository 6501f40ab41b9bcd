"""Drifts against those of simulated slopes."""

import numpy as np
import pytest
from tests.slopes.wavefront.test_fit import LAYOUT, slopes_of, slopes_of_modes

from faintspot import InputError, Wavefront, fit_wavefront
from faintspot.slopes.wavefront import fit_drift

FRAMES, NOISE_PX = 2000, 0.01
RADIUS = 3.5  # sub-apertures


def drifting(rate: float, seed: int, frames: int = FRAMES) -> Wavefront:
    """Return the fit of a recording whose astigmatism Z6 changes by `rate` px x radius from end to end."""
    true = np.zeros((frames, 9))
    true[:, 4] = rate * np.arange(frames) / frames
    positions = slopes_of_modes(LAYOUT, true)
    noise = np.random.default_rng(seed).normal(0.0, NOISE_PX, positions.shape)
    return fit_wavefront(slopes_of(positions + noise, NOISE_PX), LAYOUT, modes=9)


def test_a_drift_of_a_thousandth_of_a_pixel_is_seen() -> None:
    """Of spots at the edge, over 2000 frames with errors of 0.01 px: 5.5 standard errors."""
    change = 1e-3 / (2 * np.sqrt(6))  # Z6 has a gradient of 2 sqrt(6) at the edge
    found = fit_drift(drifting(change, 1), 20, frame_rate_hz=0.5)
    hours = FRAMES / 0.5 / 3600
    rate, error = found.rate * hours / RADIUS, found.rate_standard_error * hours / RADIUS
    assert found.time_unit == "h"
    assert found.time[-1] == pytest.approx(hours, rel=0.03)
    assert rate[4] / error[4] > 4
    assert rate[4] == pytest.approx(change, abs=3 * error[4])
    others = np.delete(rate / error, 4)
    assert np.abs(others).max() < 4  # 8 modes by Student's distribution with 18 degrees of freedom
    np.testing.assert_allclose(found.mean.mean(axis=0), drifting(change, 1).mean, atol=1e-12)


def test_drift_intervals_hold() -> None:
    """Of 30 recordings with 9 modes: 95 % with a standard error of 1.3 %; errors those of the scatter."""
    fits = [fit_drift(drifting(0.01, seed, 100), 10) for seed in range(30)]
    true = np.zeros(9)
    true[4] = 0.01 * RADIUS / 100
    held = [np.abs(found.rate - true) < found.rate_half_width for found in fits]
    assert 0.91 < np.mean(held) < 0.99
    scatter = np.std([found.mean for found in fits], axis=(0, 1))
    stated = np.sqrt(np.mean([found.standard_error**2 for found in fits], axis=(0, 1)))
    np.testing.assert_allclose(np.delete(stated, 4), np.delete(scatter, 4), rtol=0.15)


def test_drift_of_too_few_frames_is_refused() -> None:
    wavefront = drifting(0.0, 1)
    with pytest.raises(InputError, match="bins"):
        fit_drift(wavefront, 2)
    with pytest.raises(InputError, match="frame_rate_hz"):
        fit_drift(wavefront, 10, frame_rate_hz=0.0)
    one = fit_wavefront(slopes_of(np.zeros((1, 2, len(LAYOUT)))), LAYOUT)
    with pytest.raises(InputError, match="at least 6 fitted frames, got 1"):
        fit_drift(one, 3)
