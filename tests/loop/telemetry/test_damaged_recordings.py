"""Recordings that are not what they seem are right, refused or doubted: never wrong in silence."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import NOISE_PX, recorded
from tests.refusals import refused

from faintspot.loop.control.identification.preparation import gains_of_pieces, prepared
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.telemetry.report import noise_of_loop

FRAMES = 1200
HALF, THIRD = FRAMES // 2, FRAMES // 3


def with_rows(loop: Recording, rows: slice, slopes: object, commands: object = None) -> Recording:
    """Return a recording with other slopes, and perhaps commands, in some rows."""
    changed = {"slopes": loop.slopes.copy(), "commands": loop.commands.copy()}
    changed["slopes"][rows] = slopes
    if commands is not None:
        changed["commands"][rows] = commands
    return replace(loop, **changed)


def without_a_star(loop: Recording) -> Recording:
    """Return noise in the middle third, by which nothing was driven."""
    rows = slice(THIRD, 2 * THIRD)
    return with_rows(loop, rows, NOISE_PX * np.random.default_rng(1).standard_normal(loop.slopes[rows].shape))


def flipped(loop: Recording) -> Recording:
    """Return a recording whose slopes of x change their sign half way."""
    later = loop.slopes[HALF:] * np.repeat([-1, 1], len(loop.cells))
    return with_rows(loop, slice(HALF, None), later)


def open_between(loop: Recording) -> Recording:
    """Return a recording whose commands are 0 in the middle third, where the slopes are noise."""
    rows = slice(THIRD, 2 * THIRD)
    return replace(without_a_star(loop), commands=with_rows(loop, rows, 0.0, 0.0).commands)


def later_delay(loop: Recording) -> Recording:
    """Return a recording of a delay of 2 frames that becomes 3."""
    other = recorded(3, frames=FRAMES + 50)
    rows = slice(HALF, None)
    return with_rows(loop, rows, other.slopes[rows], other.commands[rows])


Change = Callable[[Recording], Recording]
REFUSED: dict[str, tuple[Change, str]] = {
    "x and y of the slopes exchanged": (
        lambda loop: replace(loop, slopes=np.roll(loop.slopes, len(loop.cells), axis=1)),
        "interaction matrix",
    ),
    "rows and columns exchanged": (lambda loop: replace(loop, cells=loop.cells[:, ::-1]), "cells"),
    "a camera that hangs after frame 100": (
        lambda loop: with_rows(loop, slice(100, None), loop.slopes[100]),
        "coherence",
    ),
    "a rate of 0": (lambda loop: replace(loop, frame_rate_hz=0.0), "frame_rate_hz"),
}
DOUBTED: dict[str, tuple[Change, str]] = {
    "the sign of x flips half way": (flipped, "usual gain"),
    "a delay of 2 that becomes 3": (later_delay, "delay is"),
    "a camera that hangs half way": (
        lambda loop: with_rows(loop, slice(HALF, None), loop.slopes[HALF]),
        "have no slopes",
    ),
}


@pytest.fixture(scope="module")
def loop() -> Recording:
    """Return a recording."""
    return recorded(frames=FRAMES + 50)


def test_commands_that_follow_otherwise_are_seen_in_pieces(loop: Recording) -> None:
    assert gains_of_pieces(prepared(loop).recording) == pytest.approx(np.ones((8, 2)), abs=0.15)
    for change in (flipped, without_a_star, open_between):
        assert gains_of_pieces(prepared(change(loop)).recording).min() < 0.3


@pytest.mark.slow
def test_refused(loop: Recording) -> None:
    for change, word in REFUSED.values():
        with refused(word):
            noise_of_loop(change(loop))


@pytest.mark.slow
@pytest.mark.parametrize("name", DOUBTED)
def test_doubted(loop: Recording, name: str) -> None:
    change, words = DOUBTED[name]
    (doubt,) = noise_of_loop(change(loop)).doubts
    assert words in doubt


@pytest.mark.slow
def test_a_recording_that_is_cut_at_60_percent_is_right(loop: Recording) -> None:
    report = noise_of_loop(loop.part(slice(int(0.6 * FRAMES))))
    assert report.doubts == []
    delay, gain, *_ = report.parts["loop"].values
    assert abs(delay.value - 2.0) < 3 * delay.error < 0.6
    assert abs(gain.value - 1.0) < 3 * gain.error < 0.6
    assert report.parts["noise"].values[0].value == pytest.approx(NOISE_PX, rel=0.03)
