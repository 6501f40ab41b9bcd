"""The loop in the engine: from a frame's slopes to the mirror's commands, and a guard that opens it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.control.base import Controller
from faintspot.control.commands import CommandDelayLine
from faintspot.control.compiled import INVALID_PART, MEAN_SQUARE, CompiledIntegrator, true_slopes
from faintspot.control.compiled_kalman import CompiledKalman
from faintspot.control.configuration import CONTROLLER, Control
from faintspot.control.guarded import Guarded
from faintspot.kernels.compiling import Direct
from faintspot.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.realtime.prior import Prior
from faintspot.realtime.timing import Latencies
from faintspot.sensor.layout import Layout

NONE, OPEN, CLOSED = "none", "open", "closed"
STATES = (NONE, OPEN, CLOSED)
"""Of a loop; telemetry has their places."""
_AT_START = "not closed since the engine began"
BY_REQUEST = "asked to"
"""Why a loop is open that somebody has opened."""
_BEYOND_OPEN = 1.25  # times the open loop's slopes: a loop that leaves more than that does harm
_LARGEST_RESIDUAL = 0.25  # of a window's side, where the open loop's are not known


class _Ready(NamedTuple):
    """A controller that can take its turn."""

    kind: str
    controller: Any
    predicts: bool
    """Whether estimators are told what it expects."""
    takes_prior: bool
    """Whether it asks how wide the prior is that slopes are drawn to."""

    @classmethod
    def of(cls, control: Control, line: CommandDelayLine) -> Self:
        controller = control.controller(line)
        return cls(
            control.options.controller,
            controller,
            control.prediction == CONTROLLER,
            isinstance(controller, (Guarded, CompiledKalman)),
        )


class ControlLoop:
    """What the engine does after a frame's slopes are out: commands of them, while the loop is closed.

    While it is open, the mirror is asked to keep what it has. `follow` and `look_after` are for the engine's
    thread, all others for any thread: they set a flag, which counts from the next frame on.

    Parameters
    ----------
    control : Control
    layout : Layout
        Of as many sub-apertures as the control is for.
    held : (commands,) array, optional
        What the mirror holds at the start. Default: it is flat.
    prior : Prior, optional
        Told what a controller that predicts expects of the next frame; nothing while the loop is open.

    Attributes
    ----------
    latencies : Latencies
        From a frame's last row to its commands.
    """

    def __init__(
        self,
        control: Control,
        layout: Layout,
        held: NDArray[np.floating] | None = None,
        prior: Prior | None = None,
    ) -> None:
        self.control, self.latencies = control, Latencies()
        self._line = control.line()
        if held is not None:
            self._line.hold(held.astype(np.float64))
        self._prior = prior
        self._ready: dict[str, _Ready] = {}
        self.make_ready(control.options.controller)
        self._on = self._ready[control.options.controller]
        self._slopes, self._errors = np.zeros((2, 2 * len(layout)))
        self._said = np.zeros(2)
        self._true_slopes = Direct(true_slopes)
        self._centroid_gain = float(control.options.centroid_gain)
        self.guard = Guard(control, layout)
        self.closed, self.opened_because = False, _AT_START
        self._flattened, self._begins, self._number = False, False, -1
        self._warm_up(len(layout))

    # The engine's thread ----------------------------------------------------------------------------

    def follow(
        self, slopes: Slopes, number: int, prior_std_px: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the commands that follow from a frame's slopes; good until the next frame.

        Parameters
        ----------
        slopes : Slopes
        number : int
            Of the frame. While others were lost, what was on its way has come nearer to the mirror.
        prior_std_px : (2 n,) array, optional
            How wide the prior around the expected slopes was that these are drawn to. Default: they are not.
        """
        line = self._line
        if number != self._number + 1 and self._number >= 0:
            for _ in range(min(number - self._number - 1, line.delay_frames)):
                line.put(line.latest)
        self._number = number
        self._true_slopes(
            slopes.x,
            slopes.y,
            slopes.flags,
            slopes.standard_error_x,
            slopes.standard_error_y,
            self._centroid_gain,
            self._slopes,
            self._errors,
            self._said,
        )
        if self._flattened:
            self._flattened = False
            line.hold(np.zeros_like(line.latest))
        if self.closed:
            on = self._on
            if on.takes_prior:
                on.controller.prior_std_px = prior_std_px if on.predicts else None
            self._update(on)
        else:
            line.put(line.latest)
        return line.latest

    def look_after(self) -> None:
        """Open the loop where the frame that was followed last shows harm, and expect the next one."""
        if not self.closed:
            self.guard.watch(self._said)
        elif reason := self.guard.objection(self._said, self._line.latest):
            self.closed, self.opened_because = False, reason
            self._flattened = self.guard.flattens
        self._expect()

    def take_turn(self, kind: str | None) -> None:
        """Let a controller have the coming frames, None: the one that is set.

        It goes on from what the mirror holds, where another one had the frames before.
        """
        new = self._ready[self.control.options.controller if kind is None else kind]
        if new is self._on:
            return
        self._on = new
        self._expect(begins=self.closed and not self._begins)

    def _expect(self, *, begins: bool = False) -> None:
        """Tell estimators what the controller, which may begin now, expects of the next frame."""
        prior, on = self._prior, self._on
        try:
            if begins:
                on.controller.begin()
            if prior is not None and on.predicts and self.closed and not self._begins:
                prior.expect(*on.controller.expected())
                return
        except Exception as error:  # in the frame path nothing raises
            self._fail(error)
        if prior is not None:
            prior.forget()

    def _update(self, on: _Ready) -> None:
        """Let a controller send its command."""
        try:
            if self._begins:
                self._begins = False
                on.controller.begin()
            on.controller.update(self._slopes, self._errors)
        except Exception as error:  # in the frame path nothing raises
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Open the loop because its controller failed; the mirror keeps the latest command."""
        self._line.hold(self._line.latest.copy())
        reason = f"the controller failed: {type(error).__name__}: {error}".split("\n")[0]
        self.closed, self.opened_because = False, self.guard.end(reason)

    # Any thread -------------------------------------------------------------------------------------

    def make_ready(self, kind: str) -> None:
        """Make a controller, for it to take its turn; one at a time.

        Raises
        ------
        InputError
            When the model of the control is not what it has learnt, or its commands are not finite.
        """
        if kind in self._ready:
            return
        control = self.control.with_controller(kind)
        control.rehearse()
        self._ready[kind] = _Ready.of(control, self._line)

    @property
    def controller(self) -> Controller:
        """That of the frame that came last."""
        controller: Controller = self._on.controller
        return controller

    def close(self) -> None:
        """Close the loop, from what the mirror holds on; of one that is closed already nothing changes."""
        if self.closed:
            return
        self.guard.begin()
        self.opened_because, self._begins = "", True
        self.closed = True

    def open(self) -> None:
        """Open the loop: the mirror keeps what it has."""
        if self.closed:
            self.opened_because = BY_REQUEST
            self.guard.end()
        self.closed = False

    def flatten(self) -> None:
        """Have the mirror flat, while the loop is open.

        Raises
        ------
        InputError
            While it is closed.
        """
        if self.closed:
            raise InputError("loop: expected an open loop to make the mirror flat; open it first")
        self._flattened = True

    @property
    def gain(self) -> float | None:
        """The loop gain of the controller that is set, or else of another one; None where none has one."""
        integrator = self._integrator
        return None if integrator is None else integrator.gain

    @gain.setter
    def gain(self, gain: float) -> None:
        """Change it.

        Raises
        ------
        InputError
            For a value out of range, and where no controller has one.
        """
        integrator = self._integrator
        if integrator is None:
            raise InputError(f"gain: the controller {self.control.options.controller!r} has none")
        integrator.gain = number_between("gain", gain, 0, 2)

    @property
    def _integrator(self) -> CompiledIntegrator | None:
        controllers = [each.controller for each in list(self._ready.values())]
        return next((each for each in controllers if isinstance(each, CompiledIntegrator)), None)

    @property
    def state(self) -> str:
        """OPEN or CLOSED."""
        return CLOSED if self.closed else OPEN

    def status(self) -> dict[str, Any]:
        """Return what there is to say, as plain values."""
        return {
            "state": self.state,
            "gain": self.gain,
            "opened_because": None if self.closed else self.opened_because,
            "controller": self._on.kind,
            "commands": self.control.commands,
            **self.guard.status(),
            "latency": self.latencies.as_dict(),
        }

    def _warm_up(self, n: int) -> None:
        """Have everything compiled; the mirror's commands stay."""
        held = self._line.latest.copy()
        self.closed = True
        self.follow(Slopes(*(np.zeros(n, kind) for kind in RESULT_TYPES)), -1)
        self.closed, self._begins = False, False
        self._line.hold(held)


class Guard:
    """Says when a loop has to be opened: it diverges, or sees too little.

    Means run over frames, in which older ones count less and less; while the loop is open, of its slopes.

    Parameters
    ----------
    control : Control
    layout : Layout
    """

    def __init__(self, control: Control, layout: Layout) -> None:
        self._options = options = control.options
        self._share = 1 / options.guard_frames
        self._usual_px = _LARGEST_RESIDUAL * max(layout.window)
        self.flattens = False
        """Whether the mirror's commands are what is wrong."""
        self._forget()
        self.begin()

    def begin(self) -> None:
        """Take the loop as closed from now on: what was seen of the open one says what is too much."""
        limit = self._options.largest_residual_px
        if limit is None and self._frames >= self._options.guard_frames:
            limit = _BEYOND_OPEN * self.residual_px
        self._largest_px = self._usual_px if limit is None else limit
        self._forget()

    def watch(self, said: NDArray[np.float64]) -> None:
        """Take a frame, of which `true_slopes` has said what it says."""
        self._frames += 1
        self._invalid += self._share * (said.item(INVALID_PART) - self._invalid)
        self._square += self._share * (said.item(MEAN_SQUARE) - self._square)

    def objection(self, said: NDArray[np.float64], commands: NDArray[np.float64]) -> str:
        """Take a frame of a closed loop and its commands; return why it has to be opened, "" for nothing.

        A mean counts from the first frame on as if all before had been 0, so that no single one decides.
        """
        self.watch(said)
        options = self._options
        if options.largest_command is not None:
            at_limit = np.count_nonzero(np.abs(commands) >= options.largest_command) / len(commands)
            self._at_limit += self._share * (at_limit - self._at_limit)
        self.flattens = True
        if self._square > self._largest_px**2:
            rms = f"{math.sqrt(self._square):.2f} px rms, more than {self._largest_px:.2f}"
            return self.end(f"diverged: slopes of {rms}")
        if self._at_limit > options.most_at_limit:
            parts = f"{100 * self._at_limit:.0f} % of the commands at their limit, more than"
            return self.end(f"diverged: {parts} {100 * options.most_at_limit:g} %")
        self.flattens = False
        if self._invalid > options.most_invalid:
            parts = f"{100 * self._invalid:.0f} % of the slopes not valid, more than"
            return self.end(f"too low flux: {parts} {100 * options.most_invalid:g} %")
        return ""

    @property
    def residual_px(self) -> float:
        """Rms of the slopes along one axis of late."""
        return math.sqrt(self._square / self._weight)

    def status(self) -> dict[str, Any]:
        """Return what it sees, as plain values."""
        return {
            "residual_px": self.residual_px,
            "invalid_part": self._invalid / self._weight,
            "at_limit_part": self._at_limit / self._weight,
        }

    @property
    def _weight(self) -> float:
        """Of all frames that were seen."""
        return 1 - (1 - self._share) ** max(self._frames, 1) if self._share < 1 else 1.0

    def end(self, reason: str = "") -> str:
        """Take the loop as open from now on, for a reason, which is returned."""
        self._forget()
        return reason

    def _forget(self) -> None:
        self._frames = 0
        self._invalid = self._square = self._at_limit = 0.0
