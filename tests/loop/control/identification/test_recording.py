"""Conventions of recorded loops: sign, rows and unit."""

import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import recorded
from tests.refusals import refused

from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import known_delay, open_loop_of
from faintspot.loop.control.identification.preparation import prepared
from faintspot.loop.control.identification.recording import Recording


def later(loop: Recording, frames: int) -> Recording:
    """Return a recording whose commands were recorded after a delay line."""
    return replace(loop, commands=np.roll(loop.commands, frames, axis=0)).part(slice(frames, None))


def test_rows_and_sign_are_found() -> None:
    loop = recorded()
    for sent, sign in product((0, 1, 3), (1.0, -1.0)):
        given = later(replace(loop, commands=sign * loop.commands), sent)
        ready = prepared(given)
        assert (ready.sign, ready.sent_after_frames) == (sign, sent)
        assert ready.loop_gain == pytest.approx(0.35, rel=0.002)
        first = given.frame[0] - loop.frame[0]
        np.testing.assert_array_equal(ready.recording.commands[:100], loop.commands[first : first + 100])
    ready = prepared(replace(loop, sent_after_frames=2))
    assert any("after 0" in remark for remark in ready.recording.remarks)


def test_lost_frames_lose_their_commands() -> None:
    loop = recorded()
    rows = np.r_[0:100, 107:400]
    gap = replace(loop, slopes=loop.slopes[rows], commands=loop.commands[rows], frame=loop.frame[rows])
    assert len(prepared(replace(gap, sent_after_frames=1)).recording.slopes) == len(rows) - 2


def test_unit_does_not_matter() -> None:
    loop = recorded()
    one = prepared(loop).recording
    for unit in (1e-6, 206265.0):
        other = replace(loop, slopes=unit * loop.slopes, interaction_matrix=unit * loop.interaction_matrix)
        two = prepared(other).recording
        np.testing.assert_allclose(two.slopes, one.slopes, rtol=1e-9)
        np.testing.assert_allclose(two.interaction_matrix, one.interaction_matrix, rtol=1e-9)
        assert two.unit == pytest.approx(unit * one.unit)


def test_commands_that_are_held_have_no_gain() -> None:
    """Each actuator has its own."""
    loop = recorded()
    held = np.broadcast_to(np.arange(loop.commands.shape[1]), loop.commands.shape)
    ready = prepared(replace(loop, commands=held))
    assert (ready.sign, ready.sent_after_frames, ready.loop_gain) == (1.0, 0, math.inf)
    assert ready.recording.interaction_matrix.any()


NOT_POSITIVE = [1e300, 0.0, -1.0]
REFUSED: dict[str, list[Any]] = {
    "frame_rate_hz": [*NOT_POSITIVE, 1e-5, None],
    "subaperture_m": [*NOT_POSITIVE, 1e-5],
    "pixel_scale_arcsec": [*NOT_POSITIVE, 1e-10],
    "delay_frames": [*NOT_POSITIVE, 1e-5],
    "sent_after_frames": [1e300, -1.0, -1, 0.5],
    "largest_command": NOT_POSITIVE,
    "gain_error": [*NOT_POSITIVE, 1e-7],
    "outer_scale_m": [*NOT_POSITIVE, 1e-5],
    "science_wavelength_m": [*NOT_POSITIVE, None],
    "unit": [*NOT_POSITIVE, None],
    "is_closed": [1e300, 0.0, None, "yes"],
    "remarks": [1e300, 0.0, None, "text"],
    "slopes": [1e300, 0.0, None],
    "commands": [1e300, 0.0, np.ones((10, 36))],
    "interaction_matrix": [1e300, 0.0, np.ones((36, 50))],
    "cells": [1e300, 0.0, np.ones((3, 3)), np.ones((25, 2))],
    "frame": [1e300, 0.0, np.zeros(20)],
    "standard_errors": [*NOT_POSITIVE, np.ones((20, 25))],
    "covariance_xy": [1e300, 0.0],
    "prior_std": [*NOT_POSITIVE, np.ones(25)],
}


def test_each_field_is_checked() -> None:
    """Also numbers that are not finite, in one line that names the field; of arrays, one wrong number."""
    loop = recorded().part(slice(0, 20))
    errors: dict[str, Any] = {"standard_errors": np.ones((20, 50)), "covariance_xy": np.ones((20, 25))}
    errors["prior_std"] = np.ones(50)
    arrays = errors | {name: getattr(loop, name) for name in ("slopes", "commands", "interaction_matrix")}
    for name, values in REFUSED.items():
        for value in (*values, *(() if name in errors else (math.nan, math.inf))):
            with refused(name):
                replace(loop, **{name: value})
            if name in arrays and np.ndim(value) == 0 and value in (1e300, -1.0):
                damaged = arrays[name].copy()
                damaged.flat[3] = value
                with refused(name):
                    replace(loop, **{name: damaged})
    for slopes in (np.ones((20, 50)), np.full((20, 50), np.nan)):
        with refused("slopes"):
            prepared(replace(loop, slopes=slopes))
    with refused("covariance_xy"):
        replace(loop, cells=None, covariance_xy=np.zeros((20, 25)))


def test_standard_errors_of_frames() -> None:
    """They take the place of the measured noise, in the unit of the prepared slopes; infinite ones too."""
    loop = recorded()
    errors = np.where(np.arange(2550)[:, None] % 2, 0.2, 0.4) * np.ones(50)
    errors[100, 7] = np.inf
    covariances = 0.01 * np.ones((2550, 25))
    ready = prepared(replace(loop, standard_errors=errors, covariance_xy=covariances)).recording
    found = open_loop_of(ready, LoopDelay(2.0, 0.0, 0.5, 0.0)).telemetry
    np.testing.assert_allclose(np.sqrt(found.variance_px2) * 0.5 * ready.unit, errors[2:], rtol=1e-9)
    covariances[100, 7] = 0.0
    np.testing.assert_allclose(found.covariances_px2 * 0.25 * ready.unit**2, covariances[2:], rtol=1e-9)
    assert found.trust.min() == found.trust[98, 7] == 0.0


def test_a_gain_that_cannot_be_known() -> None:
    """Of few frames, and of an estimator with a prior."""
    loop = recorded()
    for short, reason in (
        (loop.part(slice(0, 300)), "expected 326 consecutive frames, got 300"),
        (replace(loop, prior_std=np.full(50, 0.3)), "the estimator had a prior"),
    ):
        _, used, unknown = known_delay(replace(short, delay_frames=3.0))
        assert (used.delay_frames, used.gain) == (3.0, 1.0)
        assert reason in unknown


def test_slopes_without_sub_apertures() -> None:
    """Any number of them; constant ones are named, and no order of cells is checked."""
    loop = recorded()
    slopes, matrix = loop.slopes[:, :49].copy(), loop.interaction_matrix[:49]
    slopes[:, 4] = 0.5
    ready = prepared(Recording(slopes, -loop.commands, matrix, None, loop.frame_rate_hz))
    assert ready.sign == -1.0
    assert np.flatnonzero(np.isnan(ready.recording.slopes).all(axis=0)).tolist() == [4]
    assert any("slope 4" in remark for remark in ready.recording.remarks)


def slowly(loop: Recording, between: str, every: int = 2) -> Recording:
    """Return a loop whose sensor integrates over some rows, with slopes in the last of them alone."""
    rows: dict[str, Any] = {
        name: np.repeat(getattr(loop, name), every, axis=0) for name in ("slopes", "commands")
    }
    is_exposure = np.arange(len(rows["slopes"])) % every == every - 1
    if between == "repeats":
        rows["slopes"] = np.roll(rows["slopes"], every - 1, axis=0)
        rows["slopes"][: every - 1] = 0.0
    else:
        rows["slopes"][~is_exposure] = {"zeros": 0.0, "nothing": np.nan}[between]
    return replace(loop, **rows, frame=None, frame_rate_hz=every * loop.frame_rate_hz)


@pytest.mark.parametrize(("between", "every"), [("zeros", 2), ("repeats", 2), ("nothing", 3)])
def test_exposures_over_several_rows_are_the_frames(between: str, every: int) -> None:
    loop = recorded().part(slice(0, 400))
    ready = prepared(slowly(loop, between, every)).recording
    assert len(ready.slopes) == 400
    assert ready.frame_rate_hz == pytest.approx(loop.frame_rate_hz)
    assert np.unique(np.diff(ready.frame)).tolist() == [1]
    np.testing.assert_allclose(ready.unit * ready.slopes, loop.slopes, rtol=1e-9)
    assert any(f"{400 * (every - 1)} of" in remark for remark in ready.remarks)


def test_a_row_that_is_lost_without_a_number_loses_no_exposure() -> None:
    loop = slowly(recorded().part(slice(0, 400)), "zeros", 3)
    rows = np.arange(1200) != 301
    ready = prepared(replace(loop.part(rows), frame=None)).recording
    np.testing.assert_array_equal(ready.frame, np.arange(400))
    # A command that acts two rows later acts in the second half of the next exposure of two rows.
    loop = slowly(recorded().part(slice(0, 300)), "zeros")
    ready = prepared(replace(loop, delay_frames=2.0, sent_after_frames=1)).recording
    assert ready.delay_frames == pytest.approx(1.5)


def test_rows_of_zeros_here_and_there_are_not_measured() -> None:
    loop = recorded().part(slice(0, 400))
    slopes, blank = loop.slopes.copy(), np.arange(400) % 7 < 2
    slopes[blank] = 0.0
    ready = prepared(replace(loop, slopes=slopes)).recording
    np.testing.assert_array_equal(np.isnan(ready.slopes).all(axis=1), blank)
    np.testing.assert_array_equal(ready.commands, loop.commands)


def test_coarse_slopes_repeat_by_chance() -> None:
    slopes = np.random.default_rng(1).integers(-5, 6, (500, 2)).astype(float)
    ready = prepared(Recording(slopes, None, None, None, 100.0))
    assert np.isfinite(ready.recording.slopes).all()


REFERENCE = 0.4 * np.random.default_rng(5).standard_normal(50)


def test_references_and_a_bias_are_found_and_subtracted() -> None:
    """Within the noise of the means, 0.3 px of 2550 frames; a plain loop has neither."""
    loop = recorded()
    plain = prepared(loop)
    assert not plain.reference_slopes.any()
    assert not plain.flat_command.any()
    offset = replace(loop, slopes=2 * (loop.slopes + REFERENCE), commands=50 + 8 * loop.commands)
    ready = prepared(replace(offset, interaction_matrix=loop.interaction_matrix / 4))
    np.testing.assert_allclose(ready.reference_slopes / 2, REFERENCE, atol=0.05)
    np.testing.assert_allclose(ready.flat_command, 50 + 8 * np.median(loop.commands, axis=0), atol=4)
    spread = [one.recording.slopes.std(axis=0) * one.recording.unit for one in (ready, plain)]
    np.testing.assert_allclose(spread[0], 2 * spread[1], rtol=1e-6)
    assert ready.loop_gain == pytest.approx(0.35, rel=0.002)
    assert sum("is subtracted" in remark for remark in ready.recording.remarks) == 2


def test_stated_offsets_are_used() -> None:
    loop = recorded()
    flat = np.linspace(1, 2, 36)
    stated: Any = {"reference_slopes": REFERENCE, "flat_command": flat}
    offset = replace(loop, slopes=loop.slopes + REFERENCE, commands=loop.commands + flat, **stated)
    ready, plain = prepared(offset), prepared(loop)
    np.testing.assert_array_equal(ready.reference_slopes, REFERENCE)
    np.testing.assert_array_equal(ready.flat_command, flat)
    np.testing.assert_allclose(ready.recording.slopes, plain.recording.slopes, atol=1e-9)
    np.testing.assert_allclose(ready.recording.commands, plain.recording.commands, atol=1e-9)


def test_commands_of_another_recording_and_an_uncertain_sign_are_refused() -> None:
    """The same loop 1250 frames later is another recording."""
    loop = recorded()
    other = replace(loop.part(slice(0, 1300)), commands=loop.commands[1250:])
    noise = np.random.default_rng(1).standard_normal(loop.commands.shape)
    for wrong in (other, replace(loop, commands=noise)):
        with refused("coherence"):
            prepared(wrong)
    rng = np.random.default_rng(2)
    forwards = np.cumsum(rng.standard_normal((2000, 36)), axis=0)
    mirror = forwards @ loop.interaction_matrix.T
    seen = np.vstack([mirror[:1], mirror[:-1]])  # a quarter of a period behind its steps at all frequencies
    quadrature = replace(loop, slopes=seen, commands=forwards, frame=None)
    with refused("command_sign"):
        prepared(quadrature)
    assert prepared(replace(quadrature, command_sign=-1)).sign == -1.0
