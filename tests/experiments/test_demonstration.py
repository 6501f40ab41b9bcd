"""The demonstration: its choices are scored on other frames, and its physics is the sensor's."""

import numpy as np
import pytest
from tests.refusals import refused

from faintspot import Layout, Settings, SlopePipeline
from faintspot.experiments import demonstration
from faintspot.experiments.demonstration import CALIBRATION, READ_NOISE_E, choose, compare, simulate

LAYOUT = Layout.grid((2, 2), pixels=16)
CANDIDATES = [Settings("brightest", keep_brightest=k) for k in (8, 12, 40)]


def test_never_scored_on_the_frames_that_were_chosen_with() -> None:
    """The truth is what candidate 0 measures in the first half and candidate 2 in the second.

    Chosen on the first half, candidate 0 has no error there; scored there, its error would be 0.
    """
    frames, _ = simulate(LAYOUT, 60.0, 31, np.random.default_rng(1))
    slopes = [SlopePipeline(LAYOUT, settings, CALIBRATION)(frames) for settings in CANDIDATES]
    positions = [np.stack([s.x, s.y], axis=-1).astype(np.float64) for s in slopes]
    truth = np.concatenate([positions[0][:15], positions[2][15:]])
    method = choose(LAYOUT, CANDIDATES, frames, truth)
    assert method.settings == CANDIDATES[0]
    expected = np.abs(positions[0][15:] - positions[2][15:]).mean(axis=-1).ravel()
    np.testing.assert_allclose(method.errors, expected, rtol=1e-12)
    assert method.slope_error.value == pytest.approx(expected.mean())
    assert expected.mean() > 0
    # Chosen on the second half it would have been candidate 2, with no error at all.
    assert choose(LAYOUT, CANDIDATES, frames[::-1], truth[::-1]).settings == CANDIDATES[2]


def test_the_sensor_is_canary_like() -> None:
    layout = demonstration.demonstration_layout()
    assert len(layout) == 36
    assert layout.cells.max() == 6
    assert layout.window == (16, 16)


def test_calibrated_frames_are_the_simulated_electrons() -> None:
    """80 frames of 4 spots: dark pixels within 5 % of the read noise, flux within 5 standard errors.

    A window of 16 x 16 keeps all of a spot's flux; at a variance of 2 per electron (EMCCD) and the read
    noise of 256 pixels a spot's sum has a standard deviation of sqrt(2 * 200 + 256 * 0.09^2) = 20.
    """
    frames, truth = simulate(LAYOUT, 200.0, 80, np.random.default_rng(2))
    assert np.abs(truth).max() <= demonstration.POSITION_RANGE_PX
    stages = SlopePipeline(LAYOUT, Settings("brightest"), CALIBRATION).explain(frames)
    totals = stages.calibrated.sum(axis=(-2, -1))
    # Rounding to whole ADU (0.04 e-) and the spots' wings that leave the window are within 1 %.
    assert totals.mean() == pytest.approx(200.0, abs=5 * 20.1 / np.sqrt(totals.size) + 2)
    dark, _ = simulate(LAYOUT, 1e-6, 80, np.random.default_rng(3))
    calibrated = SlopePipeline(LAYOUT, Settings("brightest"), CALIBRATION).explain(dark).calibrated
    assert calibrated.std() == pytest.approx(READ_NOISE_E, rel=0.05)
    assert abs(calibrated.mean()) < 0.05 * READ_NOISE_E


@pytest.mark.slow
def test_compare_reports_both_modes_and_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two candidates of each kind at three fluxes: how many there are decides nothing here."""
    for name, values in {
        "FLUXES_E": (30.0, 60.0, 120.0),
        "BEST_KEPT": (8, 40),
        "STRENGTH_FACTORS": (1.0,),
    }.items():
        monkeypatch.setattr(demonstration, name, values)
    calls: list[tuple[int, int]] = []
    best, fixed = compare(12, np.random.default_rng(4), lambda *counts: calls.append(counts))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert (best.mode, fixed.mode) == ("best k", "fixed k = 40")
    for comparison in (best, fixed):
        assert len(comparison.without) == len(comparison.denoised) == 3
        for without, denoised in zip(comparison.without, comparison.denoised, strict=True):
            assert without.errors.shape == denoised.errors.shape == (6 * 36,)
            assert without.settings.estimator.name == "brightest"
            assert denoised.settings.estimator.name == "tv"
    assert all(method.settings.keep_brightest == 40 for method in fixed.without + fixed.denoised)
    difference = best.difference(1)
    assert difference.value == pytest.approx(
        best.without[1].slope_error.value - best.denoised[1].slope_error.value
    )
    assert best.flux_gain(np.random.default_rng(5)).low == best.flux_gain(np.random.default_rng(5)).low


def test_compare_needs_two_frames() -> None:
    with refused("n_frames = 1"):
        compare(1, np.random.default_rng())
