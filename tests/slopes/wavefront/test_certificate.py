"""Certificates and drifts against values that are known, and the scatter of many measurements."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import linregress
from tests.refusals import refused
from tests.slopes.wavefront.test_fit import LAYOUT, SCALED, slopes_of, slopes_of_modes

from faintspot import Layout, Wavefront, fit_wavefront
from faintspot.slopes.wavefront import certify, fit_drift
from faintspot.slopes.wavefront.zernike import zernike

TRUE = np.array([[0.3, 0.0, 0.4, 0.1, 0.0, 0.2]])
NM_PER_PX = 0.4 * np.pi / (180 * 3600) * 1e9 * 2.1


def noisy(layout: Layout, true: np.ndarray, noise: float, seed: int, frames: int = 1) -> Wavefront:
    rng, positions = np.random.default_rng(seed), slopes_of_modes(layout, true)
    slopes = slopes_of(positions + rng.normal(0.0, noise, (frames, *positions.shape[1:])), noise)
    return fit_wavefront(slopes, layout, modes=true.shape[1])


def test_sizes_of_a_wavefront_without_noise() -> None:
    found = certify(noisy(SCALED, TRUE, 1e-6, 1), wavelength_nm=4000.0)
    x, y = np.meshgrid(*[np.linspace(-1, 1, 301)[1:-1]] * 2)
    cells = np.floor(3.5 * (np.stack([y, x], axis=-1) + 1)).astype(int)
    lit = (cells[:, :, None] == SCALED.cells - SCALED.cells.min(axis=0)).all(axis=-1).any(axis=-1)
    lit &= np.hypot(x, y) <= 1
    modes = np.stack([zernike(j, x[lit], y[lit]) for j in range(1, 8)], axis=-1)
    for name, removed in (("", 1), ("_without_tilt", 3), ("_without_focus", 4)):
        surface = NM_PER_PX * modes[:, 1:] @ TRUE[0]
        surface -= modes[:, :removed] @ np.linalg.lstsq(modes[:, :removed], surface, rcond=None)[0]
        # Grids of 71 to 301 points across: means and extremes agree to 1 %.
        assert getattr(found, f"rms{name}").value == pytest.approx(surface.std(), rel=0.01)
        assert getattr(found, f"pv{name}").value == pytest.approx(np.ptp(surface), rel=0.01)
    vergence = 4e-9 * NM_PER_PX * np.sqrt(3) * 0.4 / 2.1**2
    assert found.vergence_per_m.value == pytest.approx(vergence, rel=1e-3)
    assert found.radius_of_curvature_m.value == pytest.approx(1 / vergence, rel=1e-3)
    errors = [
        each.standard_error / each.value for each in (found.radius_of_curvature_m, found.vergence_per_m)
    ]
    assert errors[0] == pytest.approx(errors[1])
    strehl = np.exp(-((2 * np.pi * found.rms_without_tilt.value / 4000.0) ** 2))
    assert found.strehl.value == pytest.approx(strehl)
    assert found.strehl.low < strehl < found.strehl.high


@pytest.mark.slow
def test_error_of_the_radius_of_curvature_is_its_scatter() -> None:
    """Over 60 measurements, whose scatter is known to 9 %; three standard errors of that."""
    defocus = np.array([noisy(SCALED, TRUE, 0.05, seed).mean[2] for seed in range(60)])
    radii = 2.1**2 / (4 * np.sqrt(3) * 1e-9 * defocus)
    stated = certify(noisy(SCALED, TRUE, 0.05, 0), draws=100).radius_of_curvature_m.standard_error
    assert stated == pytest.approx(radii.std(), rel=0.27)


def test_sizes_are_those_of_the_lit_part() -> None:
    """Defocus over an annulus, 2 sqrt(3) r^2, from its inner to its outer edge."""
    layout = Layout.grid((20, 20), pixels=8, outer_radius=10.0, inner_radius=5.0)
    found = certify(noisy(layout, np.array([[0.0, 0.0, 1.0]]), 1e-6, 1))
    radius = 10.0  # sub-apertures; lenslets cut the inner edge in steps of a tenth of the radius
    assert found.pv.value == pytest.approx(radius * 2 * np.sqrt(3) * 0.75, rel=0.1)
    assert found.rms.value == pytest.approx(radius * 2 * np.sqrt(3) * 0.75 / np.sqrt(12), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("frames", "reference"), [(1, 0), (3, 6)])
def test_rms_intervals_hold(frames: int, reference: int) -> None:
    """Sizes from 0 to far above the noise: of 40 intervals, 5 misses or fewer have a probability of 99 %."""
    held, errors = [], []
    layout = Layout.grid((5, 5), pixels=8)
    truth = certify(noisy(layout, TRUE, 1e-7, 0), draws=100).rms.value
    for seed in range(40):
        size = (0.0, 0.05, 0.2, 1.0)[seed % 4]
        fit = noisy(layout, size * TRUE, 0.1, seed, frames)
        if reference:
            other = noisy(layout, 0 * TRUE, 0.1, 1000 + seed, reference)
            fit = replace(fit, coefficients=fit.coefficients - other.mean, subtracted=other)
        rms = certify(fit, draws=1000).rms
        held.append(rms.low <= size * truth + 1e-9 and size * truth <= rms.high)
        if size == 1.0:
            errors.append((rms.value - truth) / rms.standard_error)
    assert np.mean(held) >= 35 / 40
    assert abs(np.mean(errors)) < 3 / np.sqrt(len(errors))  # unbiased


def test_errors_of_the_reference_count() -> None:
    own, other = noisy(LAYOUT, TRUE, 0.1, 1, 4), noisy(LAYOUT, 0 * TRUE, 0.2, 2, 9)
    both = replace(own, subtracted=other)
    np.testing.assert_allclose(both.mean_covariance, own.mean_covariance + other.mean_covariance)
    expected = np.hypot(own.mean_standard_error, other.mean_standard_error)
    np.testing.assert_allclose(both.mean_standard_error, expected)
    assert (own.degrees_of_freedom == 3).all()
    assert ((both.degrees_of_freedom > 3) & (both.degrees_of_freedom < 11)).all()
    assert certify(both).rms.standard_error > certify(own).rms.standard_error


def test_reference_frames_that_scatter_little_by_chance_do_not_add_certainty() -> None:
    """Three frames a tenth as noisy as their slopes tell: by Welch they would hardly count."""
    own, other = noisy(LAYOUT, TRUE, 0.1, 1, 20), noisy(LAYOUT, 0 * TRUE, 0.1, 2, 3)
    alike = other.mean + 0.1 * (other.coefficients - other.mean)
    both = replace(own, subtracted=replace(other, coefficients=alike))
    assert (both.degrees_of_freedom < 5).all()


def test_what_is_not_known() -> None:
    found = certify(noisy(LAYOUT, TRUE, 0.1, 1))
    for estimate in (found.vergence_per_m, found.radius_of_curvature_m, found.strehl):
        assert np.isnan(estimate.value)
    flat = certify(noisy(SCALED, 0 * TRUE, 0.1, 3))
    assert flat.vergence_per_m.low < 0 < flat.vergence_per_m.high
    assert np.isnan(flat.radius_of_curvature_m.value)
    assert np.isfinite(certify(noisy(LAYOUT, TRUE[:, :2], 0.1, 1)).rms_without_focus.value)
    with refused("wavelength_nm"):
        certify(noisy(LAYOUT, TRUE, 0.1, 1), wavelength_nm=-1.0)


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


@pytest.mark.slow
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


def test_drift_and_its_error_are_those_of_a_line() -> None:
    """Of few bins, where a degree of freedom counts: SciPy's regression of each mode, exactly."""
    found = fit_drift(drifting(0.01, 1, 12), 4)
    for number, values in enumerate(found.mean.T):
        line = linregress(found.time, values)
        assert found.rate[number] == pytest.approx(line.slope, rel=1e-9)
        assert found.rate_standard_error[number] == pytest.approx(line.stderr, rel=1e-9)


def test_drift_of_too_few_frames_is_refused() -> None:
    wavefront = drifting(0.0, 1)
    with refused("bins"):
        fit_drift(wavefront, 2)
    with refused("frame_rate_hz"):
        fit_drift(wavefront, 10, frame_rate_hz=0.0)
    one = fit_wavefront(slopes_of(np.zeros((1, 2, len(LAYOUT)))), LAYOUT)
    with refused("6", "got 1"):
        fit_drift(one, 3)
