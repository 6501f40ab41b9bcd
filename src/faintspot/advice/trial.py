"""A proposal and the present settings in turn on a running loop, and which of them leaves less."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.advice.centroid_gain import electrons_of, shifted_gain
from faintspot.advice.proposals import Proposal, Sensor
from faintspot.advice.residual import compared_residual, residual_wavefront
from faintspot.advice.seen import Seen, seen_in_telemetry
from faintspot.advice.watching import watch
from faintspot.base.errors import InputError
from faintspot.control.configuration import Control, prior_std_px
from faintspot.experiments.statistics import Estimate
from faintspot.io.telemetry import Telemetry
from faintspot.pipeline.settings import Settings
from faintspot.realtime.control import LENGTHY_TIMEOUT_S, request
from faintspot.realtime.control_loop import BY_REQUEST, CLOSED
from faintspot.realtime.private_socket import socket_path

Floats = NDArray[np.float64]
_TURN_FRAMES = 100
_UNEVEN = 0.2  # of what is left: so far may the figure be off between estimators that answer differently
_PRESENT = "set"


@dataclass(frozen=True)
class Verdict:
    """What a trial has shown."""

    difference: Estimate
    """Of the mean squares of the wavefronts that the proposal and what was there leave; below 0 is better."""
    left: float
    """What the present settings leave."""
    kept: bool
    """Whether the proposal is better beyond the error."""
    remark: str = ""

    @property
    def worse(self) -> bool:
        """Whether it leaves more beyond the error: then no more frames are given to it."""
        return self.difference.decided == 1

    def in_words(self, unit: str) -> str:
        """Return it as a line."""
        found = self.difference
        words = (
            f"leaves {found.value:+.3g} +- {found.standard_error:.2g} ({unit})^2 of {self.left:.3g}: "
            if np.isfinite(found.standard_error)
            else ""
        )
        taken_back = f"{'worse' if self.worse else 'not better'} beyond the error, taken back"
        return words + (self.remark or ("kept" if self.kept else taken_back))


_INTERRUPTED = Verdict(Estimate(np.nan), np.nan, False, "interrupted; taken back")


@dataclass(frozen=True, eq=False)
class Loop:
    """A running loop, and what its configuration says."""

    name: str
    control: Control
    sensor: Sensor
    modes: Floats
    """See `faintspot.advice.residual.wavefront_modes`."""
    unit: str

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        """Ask the engine."""
        return request(socket_path(self.name), command, timeout_s=LENGTHY_TIMEOUT_S, **fields)

    def settings(self) -> Settings:
        """Return the settings that run."""
        return settings_of(self.ask("get", names=None)["settings"])

    def prior_px(self, settings: Settings) -> Floats | None:
        """Return how wide the prior of an estimator is."""
        return prior_std_px(settings, self.sensor.layout)

    def centroid_gain(self, settings: Settings, frames_e: NDArray[np.float32]) -> Estimate | None:
        """Return by how much slopes grow with the spots' motion, after the control has divided them."""
        found = shifted_gain(self.sensor.pipeline(settings), frames_e, self.prior_px(settings))
        divisor = self.control.options.centroid_gain
        if found is None:
            return None
        return Estimate(found.value / divisor, found.standard_error / divisor, count=found.count)

    def check(self) -> None:
        """Make sure that the loop is closed.

        Raises
        ------
        InputError
            When it is not; it says why.
        """
        status = self.ask("loop", action="status")["loop"]
        if status["state"] != CLOSED:
            why = status.get("opened_because") or "this engine makes no commands"
            raise InputError(f"{self.name}: expected a closed loop, it is {status['state']}: {why}")


def settings_of(values: dict[str, Any]) -> Settings:
    """Return settings from what an engine says of them."""
    given = {name: value for name, value in values.items() if value is not None}
    return Settings(given.pop("estimator"), **given)


def try_on(loop: Loop, proposal: Proposal, seconds: float, stop: threading.Event) -> Verdict:
    """Have a proposal take turns with the present settings, and keep it where it is better.

    The trial ends before its time when the proposal is worse beyond the error. It is never kept before: of
    many looks one would find it better by chance.

    Whatever happens, no arms take turns afterwards; a proposal that is not better, that has the guard open
    the loop, or that is interrupted leaves everything as it was. A loop that somebody opens stays open.

    Raises
    ------
    InputError
        When the engine ends, or refuses what was there before.
    """
    loop.check()
    try:
        if proposal.gain is None:
            return _settings_in_turn(loop, proposal, seconds, stop)
        return _gains_in_turn(loop, proposal.gain, seconds, stop)
    except _OpenedError as error:
        words = f"the loop was opened: {error}; taken back"
        if str(error) != BY_REQUEST:
            loop.ask("loop", action="close")
            words += ", closed again"
        return Verdict(Estimate(np.nan), np.nan, False, words)


class _OpenedError(Exception):
    """The loop is not closed any more."""


def _settings_in_turn(loop: Loop, proposal: Proposal, seconds: float, stop: threading.Event) -> Verdict:
    before = loop.settings()
    try:
        loop.ask("interleave", arms=f"{_PRESENT},{proposal.text}", every=_TURN_FRAMES)
    except InputError as error:
        return Verdict(Estimate(np.nan), np.nan, False, f"the engine refuses it: {error}")

    def compared_so_far(telemetry: Telemetry) -> Verdict:
        arms = telemetry.arm - telemetry.attributes["first_arm"]
        own = (arms == 0) | (arms == 1)  # what came before its turns has a smaller number
        in_turn = replace(telemetry, arm=np.where(own, arms, 0), loop=np.where(own, telemetry.loop, 0))
        return _compared(loop, in_turn, [before, before.replace(**proposal.changes)])

    try:
        telemetry = watch(
            loop.name, seconds, stop, _guarded(loop), lambda so_far: compared_so_far(so_far).worse
        )
    finally:
        loop.ask("interleave", arms=_PRESENT, every=1)
    if stop.is_set():
        return _INTERRUPTED
    verdict = compared_so_far(telemetry)
    if verdict.kept:
        loop.ask("set", changes=proposal.changes, where=None)
    return verdict


def _gains_in_turn(loop: Loop, gain: float, seconds: float, stop: threading.Event) -> Verdict:
    """Change the gain back and forth; the engine's record of changes says when."""
    present = loop.ask("loop", action="status")["loop"]["gain"]
    if present is None:
        return Verdict(Estimate(np.nan), np.nan, False, "this controller has no gain to change")
    settings = loop.settings()
    guard, turn = _guarded(loop), _Turn(loop, (present, gain))
    verdict = None
    try:

        def meanwhile() -> None:
            guard()
            turn()

        def compared_so_far(telemetry: Telemetry) -> Verdict:
            in_turn = replace(telemetry, arm=_arms_of_gain(telemetry, gain))
            return _compared(loop, in_turn, [settings, settings])

        telemetry = watch(loop.name, seconds, stop, meanwhile, lambda so_far: compared_so_far(so_far).worse)
        if stop.is_set():
            return _INTERRUPTED
        verdict = compared_so_far(telemetry)
    finally:
        kept = verdict is not None and verdict.kept
        loop.ask("loop", action="gain", gain=gain if kept else present)
    return verdict


class _Turn:
    """Changes the gain when a turn is over."""

    def __init__(self, loop: Loop, gains: tuple[float, float]) -> None:
        self._loop, self._gains, self._number = loop, gains, 0
        counters = loop.ask("status")["counters"]
        self._begun = int(counters["processed"])

    def __call__(self) -> None:
        processed = int(self._loop.ask("status")["counters"]["processed"])
        if processed - self._begun >= _TURN_FRAMES:
            self._begun, self._number = processed, self._number + 1
            self._loop.ask("loop", action="gain", gain=self._gains[self._number % 2])


def _arms_of_gain(telemetry: Telemetry, gain: float) -> NDArray[np.int64]:
    """Return 1 for frames with the gain that is tried, 0 for the others."""
    arms = np.zeros(len(telemetry.frame), np.int64)
    for change in telemetry.changes:
        if "gain" in change["changes"]:
            arms[telemetry.frame > change["frame"]] = change["changes"]["gain"] == gain
    return arms


def _guarded(loop: Loop) -> Callable[[], None]:
    """Return what looks once a second whether the loop is still closed."""
    looked = time.monotonic()

    def look() -> None:
        nonlocal looked
        if time.monotonic() - looked < 1:
            return
        looked = time.monotonic()
        status = loop.ask("loop", action="status")["loop"]
        if status["state"] != CLOSED:
            raise _OpenedError(str(status["opened_because"]))

    return look


def _compared(loop: Loop, telemetry: Telemetry, settings: Sequence[Settings]) -> Verdict:
    """Say which of two arms leaves less."""
    try:
        seen = seen_in_telemetry(telemetry, loop.control, [loop.prior_px(each) for each in settings])
    except InputError as error:
        return Verdict(Estimate(np.nan), np.nan, False, str(error))
    if set(np.unique(seen.arm)) != {0, 1}:
        return Verdict(Estimate(np.nan), np.nan, False, "ended before both had their turn; taken back")
    frames = electrons_of(telemetry.raw, loop.sensor.calibration)
    number = dict(zip(telemetry.frame.tolist(), telemetry.arm.tolist(), strict=True))
    of_image = np.array([number.get(int(frame), -1) for frame in telemetry.image_frame])
    gains = []
    for arm, each in enumerate(settings):
        own = frames if settings[0] == settings[1] else frames[of_image == arm]
        gains.append(loop.centroid_gain(each, own))
    same = settings[0].estimator.name == settings[1].estimator.name
    return compared(seen, loop.modes, gains, same_settings=settings[0] == settings[1], same_estimator=same)


def compared(
    seen: Seen,
    modes: Floats,
    gains: Sequence[Estimate | None],
    *,
    same_settings: bool = False,
    same_estimator: bool = False,
) -> Verdict:
    """Return which of two arms in turn leaves less of the wavefront.

    Parameters
    ----------
    seen : Seen
        Arms 0, what was there, and 1, what is tried.
    modes : (k, m) array
    gains : sequence of Estimate
        Centroid gains of both; None where they are not known.
    same_settings : bool
        Whether the arms differ in the loop gain alone: an error of the centroid gain counts for both alike.
    same_estimator : bool
        Another one must leave a fifth less, too: so far the figure was off the truth in simulations.
    """
    if same_settings:
        gains = [gains[0] or Estimate(1.0, 0.0)] * 2
    known = [gain for gain in gains if gain is not None and gain.value > 0]
    if len(known) < 2:
        remark = "too few images to know the centroid gains; taken back"
        return Verdict(Estimate(np.nan), np.nan, False, remark)
    left = residual_wavefront(seen, modes, [gain.value for gain in known])
    errors = [0.0 if same_settings else gain.standard_error / gain.value for gain in known]
    difference = compared_residual(seen, left, errors)
    present = left[seen.arm == 0]
    mean = float(np.nanmean(present)) if np.isfinite(present).any() else np.nan
    better = difference.decided == -1
    if better and not (same_settings or same_estimator) and not difference.value < -_UNEVEN * mean:
        return Verdict(difference, mean, False, "less than estimators may seem to differ; taken back")
    return Verdict(difference, mean, better)
