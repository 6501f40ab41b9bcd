"""The loop's figure of merit: what it leaves, without the noise of the slopes that tell it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.advice.advice_cases import LAYOUT, seen_with_truth

import faintspot as fs
from faintspot.advice.loop_telemetry import LoopTelemetry
from faintspot.advice.residual import compared_residual, residual_wavefront, wavefront_modes
from faintspot.pipeline.slopes import RESULT_TYPES

MODES, UNIT = wavefront_modes(LAYOUT)


def by_arm(seen: LoopTelemetry, values: np.ndarray) -> np.ndarray:
    return np.array([np.nanmean(values[seen.arm == arm]) for arm in (0, 1)])


def test_modes_are_those_of_the_wavefront_fit() -> None:
    slopes = np.random.default_rng(2).standard_normal(2 * len(LAYOUT))
    n = len(LAYOUT)
    names = fs.Slopes.__dataclass_fields__
    fields = {name: np.zeros(n, kind) for name, kind in zip(names, RESULT_TYPES, strict=True)}
    found = fs.wavefront.fit_wavefront(fs.Slopes(**{**fields, "x": slopes[:n], "y": slopes[n:]}), LAYOUT)
    np.testing.assert_allclose(MODES @ slopes, found.coefficients[0], rtol=1e-4, atol=1e-5)
    assert found.unit == UNIT


def test_noise_is_taken_off() -> None:
    """Arms that differ in nothing but their noise leave the same; their slopes tell another thing.

    The parabola through the air's neighbours is off by less than a per cent of what is left here.
    """
    seen, residual = seen_with_truth(noise_px=(0.05, 0.3))
    truth = np.square(residual @ MODES.T).sum(axis=1)
    left = by_arm(seen, residual_wavefront(seen, MODES))
    measured = by_arm(seen, np.square(seen.slopes_px @ MODES.T).sum(axis=1))
    assert measured[1] > 3 * measured[0]
    np.testing.assert_allclose(left, by_arm(seen, truth), rtol=0.1)
    assert compared_residual(seen, residual_wavefront(seen, MODES)).decided == 0


def test_what_the_mirror_makes_of_noise_counts() -> None:
    """An arm that shows less noise but shakes the mirror is the worse one, by what it adds."""
    seen, residual = seen_with_truth(noise_px=(0.3, 0.05), extra_px=(0.0, 0.1))
    left = residual_wavefront(seen, MODES)
    found = compared_residual(seen, left)
    truth = by_arm(seen, np.square(residual @ MODES.T).sum(axis=1))
    assert found.decided == 1
    assert found.value == pytest.approx(truth[1] - truth[0], abs=4 * found.standard_error)
    assert found.count == 20


def test_a_centroid_gain_is_divided_out() -> None:
    """An arm that shows half of what there is seems better, until that is known; its error widens."""
    seen, residual = seen_with_truth(gains=(1.0, 0.5), extra_px=(0.05, 0.05))
    blind = residual_wavefront(seen, MODES)
    assert compared_residual(seen, blind).decided == -1
    known = residual_wavefront(seen, MODES, (1.0, 0.5))
    np.testing.assert_allclose(
        by_arm(seen, known), by_arm(seen, np.square(residual @ MODES.T).sum(axis=1)), rtol=0.1
    )
    exact, rough = (compared_residual(seen, known, (0.0, error)) for error in (0.0, 0.3))
    assert rough.standard_error > 2 * exact.standard_error
    assert rough.high - rough.low > 2 * (exact.high - exact.low)


def test_only_whole_turns_count() -> None:
    seen, _ = seen_with_truth(frames=600)
    left = residual_wavefront(seen, MODES)
    assert np.isnan(left[seen.since < 20]).all()
    assert np.isnan(left[[58, 59, 118, 119]]).all()
    assert np.isfinite(left[25:58]).all()
    one = seen.chosen(seen.arm == 0)
    assert len(np.unique(one.turn)) == 5
    assert np.isnan(compared_residual(one, left[seen.arm == 0]).value)
    few = np.where(seen.turn > 2, np.nan, left)  # where frames are lost, most turns may have nothing
    assert compared_residual(seen, few).count < compared_residual(seen, left).count
    assert np.isnan(compared_residual(replace(seen, turn=np.zeros(600, np.int64)), left).value)
