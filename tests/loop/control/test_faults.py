"""Sub-apertures that measure nothing and actuators that do not move, in recordings and in the loop."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.control_cases import INTERACTION, MODEL, PHASE, PLANT, telemetry
from tests.loop.control.frozen_flow import closed_loop
from tests.loop.telemetry.loop_cases import recorded
from tests.patience import mostly_slow
from tests.refusals import refused

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.faults import STUCK_FRAMES, StuckWatch, followers, still_actuators
from faintspot.loop.control.identification.preparation import prepared
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.kalman.predictor import SlopePredictor

N, DIES = 25, 300
Damage = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def x_of(number: int, values: Callable[[int, np.random.Generator], object], start: int = 0) -> Damage:
    """Return what writes the x slopes of a sub-aperture."""

    def damaged(slopes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        slopes = slopes.copy()
        slopes[start:, number] = values(len(slopes) - start, rng)
        return slopes

    return damaged


FAULTS: dict[str, tuple[Damage, list[int]]] = {
    "0": (x_of(7, lambda frames, rng: 0.0), [7]),
    "another value": (x_of(7, lambda frames, rng: 0.33), [7]),
    "two values": (x_of(7, lambda frames, rng: rng.integers(2, size=frames)), [7]),
    "three values": (x_of(7, lambda frames, rng: rng.integers(3, size=frames) - 1.0), [7]),
    "not measured": (x_of(7, lambda frames, rng: np.nan), []),
    "dies": (x_of(7, lambda frames, rng: 0.0, DIES), [7]),
    "many values": (x_of(7, lambda frames, rng: np.round(rng.standard_normal(frames), 1)), []),
}


def both_of(number: int, value: float, noise: float) -> Damage:
    """Return what writes slopes that hardly change, as of a window with a hot pixel."""

    def damaged(slopes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        slopes = slopes.copy()
        slopes[:, [number, number + N]] = value + noise * rng.standard_normal((len(slopes), 2))
        return slopes

    return damaged


FAULTS |= {
    "hot pixel": (both_of(7, 0.8, 0.05), [7]),
    "nearly 0": (both_of(7, 0.0, 0.001), [7]),
    "half the gain": (lambda slopes, rng: slopes * np.where(np.arange(2 * N) % N == 7, 0.5, 1.0), []),
}


@pytest.mark.parametrize("name", mostly_slow(3, FAULTS))
def test_recording_with_a_fault(name: str) -> None:
    """What sticks is not measured, from its first frame on, nor is the other axis of the sub-aperture."""
    damage, stuck = FAULTS[name]
    loop = recorded(frames=900)
    ready = prepared(replace(loop, slopes=damage(loop.slopes, np.random.default_rng(1)))).recording
    missing = np.isnan(ready.slopes).reshape(-1, 2, N)
    start = DIES if name == "dies" else 0
    assert missing[start:, :, stuck].all()
    assert not missing[: max(0, start - STUCK_FRAMES), :, stuck].any()
    assert not np.delete(missing, 7, axis=2).any()
    assert any("sub-aperture 7 (row 1, column 2)" in remark for remark in ready.remarks) == bool(stuck)


def test_sub_apertures_with_the_same_slopes_and_rows_of_zero() -> None:
    """Which of the two follows the other is not known."""
    loop = recorded(frames=900)
    slopes, matrix = loop.slopes.copy(), loop.interaction_matrix.copy()
    slopes[:, 3] = 2.0 * slopes[:, N + 9] + 1.0
    matrix[[20, N + 20]] = 0.0
    ready = prepared(replace(loop, slopes=slopes, interaction_matrix=matrix)).recording
    assert np.flatnonzero(np.isnan(ready.slopes[0, :N])).tolist() == [3, 9, 20]
    assert sum("sub-aperture" in remark for remark in ready.remarks) == 2
    assert not followers(loop.slopes).any()


@pytest.mark.parametrize("delay", mostly_slow(1, [1, 3]))
def test_no_sub_aperture_of_a_sound_loop_is_silent(delay: int) -> None:
    loop = recorded(delay, 0.6, frames=900)
    assert np.isfinite(prepared(loop).recording.slopes).all()


def test_rows_that_repeat_are_not_measured() -> None:
    watch, rng = StuckWatch(2 * N), np.random.default_rng(4)
    errors = np.ones(2 * N)
    rows = rng.standard_normal((4, 2 * N))
    for number, is_new in ((0, True), (1, True), (1, False), (0, True), (0, False)):
        used = watch(rows[number], errors)
        assert np.isfinite(used).all() if is_new else np.isinf(used).all()


def test_a_recording_in_which_everything_is_stuck() -> None:
    loop = recorded(frames=900)
    with refused("sub-apertures 0 "):
        prepared(replace(loop, slopes=np.sign(loop.slopes)))


def loop_with(still: int | None, noise_px: float, delay: int) -> Recording:
    """Return a loop of an integrator, one of whose actuators does not move."""
    loop, rng = recorded(frames=1500), np.random.default_rng(4)
    interaction = np.asarray(loop.interaction_matrix)
    mirror = interaction.copy()
    if still is not None:
        mirror[:, still] = 0.0
    before = np.vstack([np.zeros((2, 36)), loop.commands[:-2]])
    turbulence = loop.slopes - before @ interaction.T
    noise, inverse = noise_px * rng.standard_normal(turbulence.shape), np.linalg.pinv(interaction, rcond=0.05)
    slopes, commands = closed_loop(turbulence, noise, mirror, inverse, delay=delay, loop_gain=0.35)
    return replace(loop, slopes=slopes, commands=commands)


@pytest.mark.parametrize(
    ("still", "noise_px", "delay"),
    mostly_slow(1, [(None, 0.5, 2), (14, 0.2, 1), (None, 0.0, 1), (0, 0.0, 2), (0, 0.5, 3), (14, 0.5, 2)]),
)
def test_an_actuator_that_does_not_move(still: int | None, noise_px: float, delay: int) -> None:
    loop = loop_with(still, noise_px, delay)
    found = still_actuators(loop.slopes, loop.commands, np.asarray(loop.interaction_matrix))
    assert np.flatnonzero(found).tolist() == ([] if still is None else [still])
    ready = prepared(loop).recording
    assert (
        np.flatnonzero(~np.any(ready.interaction_matrix, axis=0)).tolist() == np.flatnonzero(found).tolist()
    )


def test_a_sub_aperture_that_begins_to_follow_another_one() -> None:
    """Noticed within 200 frames: neither is used until they differ again. Common motion is no fault."""
    rng, watch, m = np.random.default_rng(3), StuckWatch(2 * N), 2 * N
    errors, stuck = np.full(m, 0.1), []
    for frame in range(900):
        slopes = rng.standard_normal(m)
        if 100 <= frame < 500:
            slopes[N + 9] = 2.0 * slopes[3] + 1.0
        if frame >= 700:
            slopes[:] = slopes[0]
        assert np.array_equal(np.isinf(watch(slopes, errors)), np.tile(watch.is_stuck, 2))
        stuck.append(np.flatnonzero(watch.is_stuck).tolist())
    assert stuck[100] == []
    assert stuck[299] == [3, 9]
    assert stuck[700:] == [[]] * 200


@pytest.mark.parametrize("values", [[0.0], [0.33], [0.0, 1.0]])
def test_a_sub_aperture_that_dies_in_the_loop_is_left_out_until_it_lives(values: list[float]) -> None:
    """Noticed within 200 frames; then its slopes have no influence, also a single other value."""
    lines, controllers, stuck = [CommandDelayLine(12, 2) for _ in range(2)], [], []
    for line in lines:
        predictor = SlopePredictor(MODEL, np.full(18, 0.25), np.zeros(9))
        controllers.append(CompiledKalman(line, PLANT, PHASE, predictor, 0.4))
    for number, open_loop in enumerate(telemetry(450).open_loop_px):
        for which, (controller, line) in enumerate(zip(controllers, lines, strict=True)):
            slopes = open_loop + INTERACTION @ line.acting
            if 100 <= number < 300:
                slopes[4] = 5.0 if which and number == 250 else values[number % len(values)]
            controller.update(slopes, np.full(18, 0.5))
        if number < 300:
            np.testing.assert_array_equal(lines[0].latest, lines[1].latest)
        stuck.append(np.flatnonzero(controllers[0].is_stuck).tolist())
    assert stuck[100] == []
    assert stuck[199] == stuck[320] == [4]
    assert stuck[-1] == []
