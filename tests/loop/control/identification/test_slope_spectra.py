from dataclasses import replace

import numpy as np
from tests.loop.control.control_cases import TURBULENCE

from faintspot.loop.control.identification.slope_spectra import SlopeSpectra

LENGTH, STEP_S = 24, 0.01
BINS = np.array([1, 4, 9])
WINDOW = np.hanning(LENGTH + 2)[1:-1] / np.linalg.norm(np.hanning(LENGTH + 2))
SPECTRA = SlopeSpectra(TURBULENCE, STEP_S, WINDOW, BINS, 10.0)
WIND = np.array([7.0, -11.0])


def test_they_are_the_transform_of_the_covariances() -> None:
    """Added up lag by lag; the table of covariances is interpolated to a thousandth of the largest."""
    outer_scale_m = 17.0
    layer = replace(
        TURBULENCE, r0_m=1.0, outer_scale_m=outer_scale_m, fraction=np.ones(1), wind_m_per_s=WIND[None]
    )
    weight = np.correlate(WINDOW, WINDOW, "full")
    expected = np.zeros((len(BINS), 18, 18), complex)
    for place, lag in enumerate(range(1 - LENGTH, LENGTH)):
        turn = np.exp(-2j * np.pi / LENGTH * BINS * lag)
        expected += (weight[place] * turn)[:, None, None] * layer.covariance_px2(lag * STEP_S)
    tables, _ = SPECTRA.tables(outer_scale_m)
    found = SPECTRA.matrices(SPECTRA.of_wind(WIND, tables))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(found, found.conj().swapaxes(1, 2), rtol=0, atol=1e-12)


def test_tables_follow_the_outer_scale() -> None:
    """Their derivative is that of a step."""
    (low, slope), (high, _) = (SPECTRA.tables(scale_m) for scale_m in (20.0, 20.0 * np.exp(0.01)))
    np.testing.assert_allclose(high - low, 0.01 * slope, rtol=1e-6, atol=1e-9 * np.abs(slope).max())


def test_derivatives_are_those_of_steps() -> None:
    tables, slopes = SPECTRA.tables(25.0)
    value, *found = SPECTRA.changes(WIND, tables, slopes)
    np.testing.assert_allclose(value, SPECTRA.of_wind(WIND, tables), rtol=0, atol=1e-15)
    step = 1e-4
    stepped = [(WIND + step * each, tables) for each in np.eye(2)] + [(WIND, tables + step * slopes)]
    for derivative, place in zip(found, stepped, strict=True):
        expected = (SPECTRA.of_wind(*place) - value) / step
        np.testing.assert_allclose(derivative, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def test_sums_over_pairs() -> None:
    rng = np.random.default_rng(1)
    tables, _ = SPECTRA.tables(25.0)
    distinct = SPECTRA.of_wind(WIND, tables)
    half = rng.standard_normal((2, len(BINS), 18, 18))
    gradient = half[0] + 1j * half[1]
    gradient = gradient + gradient.conj().swapaxes(1, 2)
    expected = np.einsum("fij,fji->", gradient, SPECTRA.matrices(distinct)).real
    np.testing.assert_allclose((SPECTRA.summed(gradient) * distinct).sum().real, expected)
