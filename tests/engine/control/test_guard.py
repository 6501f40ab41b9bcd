"""The guard against a window's slopes: those of spots that have left it are small."""

from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.control_cases import INTERACTION

from faintspot.engine.control.control_loop import ControlLoop
from faintspot.engine.control.guard import Guard, LostSpots
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.integrator import INVALID_PART, MEAN_SQUARE
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout

LAYOUT = Layout.grid((3, 3), pixels=16)
N, COMMANDS = len(LAYOUT), INTERACTION.shape[1]
FLUX_E, WINDOW_PX = 100.0, 1.5
OPTIONS = ControlOptions(gain=0.4, guard_frames=20, proven_frames=200)


class Star:
    """A star behind a mirror, seen through Gaussian windows that are divided by its expected flux."""

    def __init__(self) -> None:
        self._rng, self.flux_e, self.turbulence_px, self.sign = np.random.default_rng(3), FLUX_E, 0.5, 1.0
        self._turbulence = np.zeros(COMMANDS)

    def slopes(self, commands: np.ndarray) -> Slopes:
        """Return the slopes of the next frame."""
        change = self._rng.normal(0, 0.15 * self.turbulence_px, COMMANDS) / COMMANDS**0.5
        self._turbulence = 0.99 * self._turbulence + change
        place = INTERACTION @ (self._turbulence + self.sign * commands)
        within = np.exp(-0.5 * np.square(place).reshape(2, N).sum(axis=0) / WINDOW_PX**2)
        slopes = Slopes(*(np.zeros(N, kind) for kind in RESULT_TYPES))
        seen = within * self.flux_e + self._rng.normal(0, 5.0, N)
        x, y = (place * np.tile(within, 2) * self.flux_e / FLUX_E).reshape(2, N)
        return replace(slopes, x=x.astype("f4"), y=y.astype("f4"), flux=seen.astype("f4"))


class Run:
    """A loop that has been closed on a star for a number of frames."""

    def __init__(self, frames: int, options: ControlOptions = OPTIONS) -> None:
        self.star, self.loop = Star(), ControlLoop(Control(INTERACTION, None, options), LAYOUT)
        self._sent, self._number = [np.zeros(COMMANDS)] * options.delay_frames, 0
        self.frames(30)
        self.loop.close()
        self.frames(frames)
        assert self.loop.closed

    def frames(self, count: int) -> None:
        """Let frames come."""
        for _ in range(count):
            slopes = self.star.slopes(self._sent.pop(0))
            self._sent.append(self.loop.follow(slopes, self._number).copy())
            self.loop.look_after(slopes.flux)
            self._number += 1

    def frames_until_open(self, most: int = 300) -> int:
        """Return how many frames came until the loop was open."""
        for count in range(most):
            if not self.loop.closed:
                return count
            self.frames(1)
        return most


@pytest.mark.parametrize(
    ("event", "opens"), [({"sign": -1.0}, True), ({"flux_e": 16.0}, False), ({"turbulence_px": 0.9}, False)]
)
def test_spots_that_leave_the_windows_open_the_loop(event: dict[str, float], opens: bool) -> None:
    """A loop of the wrong sign does; a star that fades by two magnitudes and strong turbulence do not."""
    run = Run(100)
    vars(run.star).update(event)
    assert (run.frames_until_open() < 300) == opens
    if opens:
        assert "of the flux left" in run.loop.opened_because
        run.frames(3)
        assert not run.loop.follow(run.star.slopes(np.zeros(COMMANDS)), 10_000).any()


def test_one_bad_frame_does_not_open_the_loop() -> None:
    run = Run(100)
    seen = run.star.slopes

    def bad(commands: np.ndarray) -> Slopes:
        return replace(seen(commands), x=np.full(N, 6.0, "f4"))

    run.star.slopes = bad  # type: ignore[method-assign]
    run.frames(1)
    run.star.slopes = seen  # type: ignore[method-assign]
    run.frames(100)
    assert run.loop.closed


@pytest.mark.parametrize(
    ("frames", "asked", "again"), [(250, "", True), (100, "", False), (250, "open", False)]
)
def test_a_proven_loop_is_closed_again(frames: int, asked: str, again: bool) -> None:
    """Once its cause has passed; not a loop that was new, nor one that somebody has opened since."""
    run = Run(frames)
    run.star.sign = -1.0
    assert run.frames_until_open() < 300
    run.star.sign = 1.0
    if asked:
        run.loop.open()
    run.frames(100)
    assert run.loop.closed == again
    status = run.loop.status()
    assert (status["closed_again_because"] is not None) == again
    assert (status["opened_because"] is None) == again


@pytest.mark.parametrize(("part", "again"), [(0.45, True), (0.55, False)])
def test_a_loop_is_closed_again_at_half_the_invalid_slopes(part: float, again: bool) -> None:
    """That have opened it, as fractions of the limit."""
    guard = Guard(Control(INTERACTION, None, OPTIONS), LAYOUT)
    commands, flux, summary = np.zeros(COMMANDS), np.full(N, 100.0, "f4"), np.zeros(8)
    guard.begin()

    def opened(frames: int) -> bool:
        return any(guard.objection(summary, commands, flux, commands) for _ in range(frames))

    assert not opened(OPTIONS.proven_frames)
    summary[INVALID_PART] = 0.95 * OPTIONS.most_invalid
    assert not opened(300)
    summary[INVALID_PART] = 1.05 * OPTIONS.most_invalid
    assert opened(300)
    summary[INVALID_PART] = part * OPTIONS.most_invalid
    for _ in range(300):
        guard.watch(summary, commands, flux)
    assert guard.may_close_again == again


@pytest.mark.parametrize(("proven_frames", "again"), [(0, False), (1, True)])
def test_without_a_number_of_frames_no_loop_is_proven(proven_frames: int, again: bool) -> None:
    guard = guarded(proven_frames=proven_frames)
    assert reason(guard, invalid=1.0)
    assert not guard.flattens  # the mirror keeps what it has
    for _ in range(300):
        guard.watch(np.zeros(8), FLAT, FLUX)
    assert guard.may_close_again == again


FLUX, FLAT = np.full(N, 100.0, "f4"), np.zeros(COMMANDS)


def guarded(**options: float) -> Guard:
    """Return the guard of a loop that has just been closed."""
    guard = Guard(Control(INTERACTION, None, OPTIONS.replaced(options)), LAYOUT)
    guard.begin()
    return guard


def reason(guard: Guard, *, square_px2: float = 0.0, invalid: float = 0.0, at_limit: int = 0) -> str:
    """Return why a loop opens within 300 frames, 15 times the guard's memory, that are all the same."""
    summary, latest = np.zeros(8), np.zeros(COMMANDS)
    summary[MEAN_SQUARE], summary[INVALID_PART] = square_px2, invalid
    latest[:at_limit] = -10.0
    return next(filter(None, (guard.objection(summary, FLAT, FLUX, latest) for _ in range(300))), "")


@pytest.mark.parametrize("limit_px", [None, 0.6])
def test_a_loop_opens_at_its_largest_residual(limit_px: float | None) -> None:
    """Without a stated one at a quarter of a window, here 4 px."""
    options = {} if limit_px is None else {"largest_residual_px": limit_px}
    largest = limit_px or 4.0
    assert not reason(guarded(**options), square_px2=(0.98 * largest) ** 2)
    opened = guarded(**options)
    assert f"more than {largest:.2f}" in reason(opened, square_px2=(1.02 * largest) ** 2)
    assert opened.flattens


def test_slopes_of_the_open_loop_are_the_limit_where_they_are_known() -> None:
    for size, opens in ((1.22, False), (1.28, True)):
        guard = guarded()
        guard.end()
        summary = np.zeros(8)
        summary[MEAN_SQUARE] = 0.7**2
        for _ in range(OPTIONS.guard_frames):
            guard.watch(summary, FLAT, FLUX)
        guard.begin()
        assert bool(reason(guard, square_px2=(0.7 * size) ** 2)) == opens


def test_commands_at_their_limit_open_the_loop() -> None:
    options = {"largest_command": 10.0, "most_at_limit": 0.3}  # 3.6 of 12
    assert not reason(guarded(**options), at_limit=3)
    assert "of the commands at their limit, more than 30 %" in reason(guarded(**options), at_limit=4)


def test_figures_of_the_guard_are_means_of_late() -> None:
    """Also of few frames, which are not diluted with earlier ones that there were not."""
    guard = guarded(largest_command=10.0, most_at_limit=0.9, most_invalid=0.9)
    summary, latest = np.zeros(8), np.zeros(COMMANDS)
    summary[MEAN_SQUARE], summary[INVALID_PART], latest[:6] = 0.8**2, 0.2, 10.0
    for _ in range(3):
        assert not guard.objection(summary, FLAT, FLUX, latest)
        assert guard.status() == pytest.approx(
            {"residual_px": 0.8, "invalid_part": 0.2, "at_limit_part": 0.5}
        )


@pytest.mark.parametrize(("flux", "lost"), [(0.30, True), (0.37, False)])
def test_spots_are_lost_where_their_flux_is_low_when_they_are_displaced(flux: float, lost: bool) -> None:
    """Displaced in half of the frames: mean(F d^2) < 0.5 mean(F) mean(d^2) at a third of the flux."""
    spots = LostSpots(INTERACTION, 20)
    for frame in range(200):
        moved = frame >= 100
        spots.take(np.full(COMMANDS, float(moved)), FLUX * np.float32(flux if moved else 1.0))
    assert spots.lost == lost
