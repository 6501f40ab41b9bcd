"""Frames of telemetry with gaps, priors and open loops that can be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.loop.telemetry.advice_cases import LAYOUT, RATE_HZ, recording, seen_with_truth

from faintspot.base.errors import InputError
from faintspot.loop.control.configuration import Control, ControlOptions
from faintspot.loop.telemetry.engine_telemetry import seen_in_telemetry

M, COMMANDS = 2 * len(LAYOUT), 5
RNG = np.random.default_rng(4)
MATRIX = RNG.standard_normal((M, COMMANDS))
SEEN, _ = seen_with_truth(frames=400)
SENT = RNG.standard_normal((400, COMMANDS)).astype(np.float32)


def control(**options: Any) -> Control:
    return Control(MATRIX, None, ControlOptions(delay_frames=2, **options))


def test_slopes_and_commands() -> None:
    found = seen_in_telemetry(recording(SEEN, SENT, 2), control(centroid_gain=0.5))
    assert len(found) == 398
    np.testing.assert_allclose(found.slopes_px, 2 * SEEN.slopes_px[2:], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.held_px, SENT[:-2] @ MATRIX.T, rtol=1e-5, atol=1e-5)
    assert not found.segment.any()
    assert found.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)


def test_lost_frames_and_an_open_loop_are_left_out() -> None:
    """The mirror is known of frames whose command, two frames before, is there and came of a closed loop."""
    frame = np.arange(400)
    frame[310:] += 1
    loop = np.full(400, 2)
    loop[100:103] = 1
    found = seen_in_telemetry(recording(SEEN, SENT, 2, frame=frame, loop=loop), control())
    assert len(found) == 400 - 2 - 5 - 2
    assert len(np.unique(found.segment)) == 3


def test_a_prior_is_taken_out_around_what_was_expected() -> None:
    """A posterior as wide as 0.1 px around a prior of 0.2 px: 3 / 4 is the frame's, 1 / 4 was expected."""
    prior = np.full(M, 0.2)
    predicted = control(prediction="controller")
    expected = (SENT[:-2] - SENT[1:-1]) @ MATRIX.T
    found = seen_in_telemetry(recording(SEEN, SENT, 2), predicted, prior)
    alone = expected + (SEEN.slopes_px[2:] - expected) * 4 / 3
    np.testing.assert_allclose(found.slopes_px, alone, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.trust, 0.75, rtol=1e-5)


def test_refusals() -> None:
    whole = recording(SEEN, SENT, 2)
    with pytest.raises(InputError, match="expected 5 commands, as the interaction matrix has, got 3"):
        seen_in_telemetry(replace(whole, commands=SENT[:, :3]), control())
    with pytest.raises(InputError, match="expected 200 frames of a closed loop, got 0"):
        seen_in_telemetry(replace(whole, loop=np.ones(400, np.int64)), control())
    with pytest.raises(InputError, match="got 0"):
        seen_in_telemetry(recording(seen_with_truth(frames=2)[0], SENT[:2], 2), control())
    endless = np.full_like(whole.standard_error_x, np.inf)
    with pytest.raises(InputError, match="expected standard errors"):
        seen_in_telemetry(replace(whole, standard_error_x=endless, standard_error_y=endless), control())
    with pytest.raises(InputError, match="expected an integrator"):
        seen_in_telemetry(whole, control(prediction="stream"), np.full(M, 0.2))
