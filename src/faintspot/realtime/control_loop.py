"""The loop in the engine: commands from slopes, and a guard that opens the loop."""

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
"""States of a loop; telemetry stores their index."""
_AT_START = "not closed since the engine began"
BY_REQUEST = "asked to"
"""Reason given when a user has opened the loop."""
_BEYOND_OPEN = 1.25  # times the open loop's slopes; a loop that leaves more makes things worse
_LARGEST_RESIDUAL = 0.25  # of a window's side, used if the open loop's slopes are not known


class _Ready(NamedTuple):
    """A controller that has been prepared."""

    kind: str
    controller: Any
    predicts: bool
    """Whether its prediction goes to the estimators as a prior."""
    takes_prior: bool
    """Whether it uses the width of the prior of the slopes."""

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
    """Control loop of an engine: computes the mirror's commands from published slopes while it is closed.

    While the loop is open, the mirror keeps its commands. `follow` and `look_after` are for the engine's
    thread. All other methods are for any thread: they set a flag that takes effect with the next frame.

    Parameters
    ----------
    control : Control
    layout : Layout
        Layout with as many sub-apertures as the control.
    held : (commands,) array, optional
        The mirror's commands at the start. Default: flat.
    prior : Prior, optional
        Receives the prediction of the next frame's slopes from a predictive controller while the loop is
        closed.

    Attributes
    ----------
    latencies : Latencies
        Latency from a frame's last row to its commands.
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
        """Return the commands that follow from a frame's slopes; valid until the next frame.

        Parameters
        ----------
        slopes : Slopes
        number : int
            Frame number. Commands in the delay line advance by the number of lost frames, too.
            prior_std_px : (2 n,) array, optional
                Width of the prior around the predicted slopes that was used for these. Default: no prior.
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
        """Open the loop if the last frame shows a fault, and predict the next frame."""
        if not self.closed:
            self.guard.watch(self._said)
        elif reason := self.guard.objection(self._said, self._line.latest):
            self.closed, self.opened_because = False, reason
            self._flattened = self.guard.flattens
        self._expect()

    def take_turn(self, kind: str | None) -> None:
        """Hand the coming frames to a controller; None: the configured one.

        It starts from the mirror's present commands if another controller had the frames before.
        """
        new = self._ready[self.control.options.controller if kind is None else kind]
        if new is self._on:
            return
        self._on = new
        self._expect(begins=self.closed and not self._begins)

    def _expect(self, *, begins: bool = False) -> None:
        """Give the estimators the prediction of the next frame by the controller, which may begin now."""
        prior, on = self._prior, self._on
        try:
            if begins:
                on.controller.begin()
            if prior is not None and on.predicts and self.closed and not self._begins:
                prior.expect(*on.controller.expected())
                return
        except Exception as error:  # nothing raises in the frame path
            self._fail(error)
        if prior is not None:
            prior.forget()

    def _update(self, on: _Ready) -> None:
        """Let a controller compute its command from the slopes."""
        try:
            if self._begins:
                self._begins = False
                on.controller.begin()
            on.controller.update(self._slopes, self._errors)
        except Exception as error:  # nothing raises in the frame path
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Open the loop because its controller failed; the mirror keeps the latest command."""
        self._line.hold(self._line.latest.copy())
        reason = f"the controller failed: {type(error).__name__}: {error}".split("\n")[0]
        self.closed, self.opened_because = False, self.guard.end(reason)

    # Any thread -------------------------------------------------------------------------------------

    def make_ready(self, kind: str) -> None:
        """Prepare a controller, one at a time, so that it can be used.

        Raises
        ------
        InputError
            When the control model is not the learnt one, or its commands are not finite.
        """
        if kind in self._ready:
            return
        control = self.control.with_controller(kind)
        control.rehearse()
        self._ready[kind] = _Ready.of(control, self._line)

    @property
    def controller(self) -> Controller:
        """Controller of the last frame."""
        controller: Controller = self._on.controller
        return controller

    def close(self) -> None:
        """Close the loop, starting from the mirror's present commands; no effect if it is closed."""
        if self.closed:
            return
        self.guard.begin()
        self.opened_because, self._begins = "", True
        self.closed = True

    def open(self) -> None:
        """Open the loop; the mirror keeps its commands."""
        if self.closed:
            self.opened_because = BY_REQUEST
            self.guard.end()
        self.closed = False

    def flatten(self) -> None:
        """Flatten the mirror while the loop is open.

        Raises
        ------
        InputError
            When the loop is closed.
        """
        if self.closed:
            raise InputError("loop: is closed, expected it open to flatten the mirror; open it first")
        self._flattened = True

    @property
    def gain(self) -> float | None:
        """Loop gain of the configured controller, or of another one if it has none; None if none has one."""
        integrator = self._integrator
        return None if integrator is None else integrator.gain

    @gain.setter
    def gain(self, gain: float) -> None:
        """Change the loop gain.

        Raises
        ------
        InputError
            When the value is out of range, or no controller has a gain.
        """
        integrator = self._integrator
        if integrator is None:
            raise InputError(f"gain: the controller {self.control.options.controller!r} has no gain")
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
        """Return the loop's state and figures as plain values."""
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
        """Compile all controllers; the mirror's commands stay."""
        held = self._line.latest.copy()
        self.closed = True
        self.follow(Slopes(*(np.zeros(n, kind) for kind in RESULT_TYPES)), -1)
        self.closed, self._begins = False, False
        self._line.hold(held)


class Guard:
    """Monitor that detects when a loop must be opened: it diverges, or the flux is too low.

    Means are exponentially weighted over frames. While the loop is open, they measure its slopes.

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
        """Whether the mirror should be flattened, because its commands are at fault."""
        self._forget()
        self.begin()

    def begin(self) -> None:
        """Treat the loop as closed from now on; the open loop's slopes set the limit."""
        limit = self._options.largest_residual_px
        if limit is None and self._frames >= self._options.guard_frames:
            limit = _BEYOND_OPEN * self.residual_px
        self._largest_px = self._usual_px if limit is None else limit
        self._forget()

    def watch(self, said: NDArray[np.float64]) -> None:
        """Take the summary that `true_slopes` gives of a frame."""
        self._frames += 1
        self._invalid += self._share * (said.item(INVALID_PART) - self._invalid)
        self._square += self._share * (said.item(MEAN_SQUARE) - self._square)

    def objection(self, said: NDArray[np.float64], commands: NDArray[np.float64]) -> str:
        """Take a frame of a closed loop and its commands; return why the loop must be opened, or "".

        A mean starts as if all earlier values had been 0, so that no single frame decides.
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
        """Recent rms of the slopes along one axis."""
        return math.sqrt(self._square / self._weight)

    def status(self) -> dict[str, Any]:
        """Return the guard's figures as plain values."""
        return {
            "residual_px": self.residual_px,
            "invalid_part": self._invalid / self._weight,
            "at_limit_part": self._at_limit / self._weight,
        }

    @property
    def _weight(self) -> float:
        """Total weight of the frames so far."""
        return 1 - (1 - self._share) ** max(self._frames, 1) if self._share < 1 else 1.0

    def end(self, reason: str = "") -> str:
        """Treat the loop as open from now on; return the reason."""
        self._forget()
        return reason

    def _forget(self) -> None:
        self._frames = 0
        self._invalid = self._square = self._at_limit = 0.0
