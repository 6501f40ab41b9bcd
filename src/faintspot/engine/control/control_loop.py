"""The loop in the engine: commands from slopes, and a guard that opens the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.engine.control.guard import ControllerSuccessor, Guard, PreparedController
from faintspot.engine.frames.timing import Latencies
from faintspot.engine.frames.workers import SlopePrior
from faintspot.loop.control.base import KALMAN, CommandDelayLine, Controller
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.integrator import MEAN_SQUARE, true_slopes
from faintspot.slopes.estimators.registry import one_line
from faintspot.slopes.kernels.compiling import Direct
from faintspot.slopes.kernels.products import ProductPart
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from faintspot.loop.control.identification.model import Kalman


NONE, OPEN, CLOSED = "none", "open", "closed"
STATES = (NONE, OPEN, CLOSED)
"""States of a loop; telemetry stores their index."""
_AT_START = "not closed since the engine began"
BY_REQUEST = "asked to"
"""Reason given when a user has opened the loop."""


class ControlLoop:
    """Control loop of an engine: computes the mirror's commands from published slopes while it is closed.

    While the loop is open, the mirror keeps its commands. `follow` and `look_after` are for the engine's
    thread. All other methods are for any thread: they set a flag that takes effect with the next frame.

    Parameters
    ----------
    control : Control
    layout : Layout
        Layout with as many sub-apertures as the control.
    commands : (commands,) array, optional
        The mirror's commands at the start. Default: flat.
    prior : SlopePrior, optional
        Receives the prediction of the next frame's slopes from a predictive controller while the loop is
        closed.
    threads : int
        Number of threads that measure.

    Attributes
    ----------
    latencies : Latencies
        Latency from a frame's last row to its commands.
    """

    def __init__(
        self,
        control: Control,
        layout: Layout,
        commands: NDArray[np.floating] | None = None,
        prior: SlopePrior | None = None,
        threads: int = 1,
    ) -> None:
        self.control, self.latencies, self._threads = control, Latencies(), threads
        self._prior = prior
        self._ready: dict[str, PreparedController] = {}
        self._successor: ControllerSuccessor | None = None
        self.make_ready(control.options.controller)
        self._on = self._ready[control.options.controller]
        if commands is not None:
            self._line.hold(commands.astype(np.float64))
        self._slopes, self._errors = np.zeros((2, 2 * len(layout)))
        self._covariance = np.zeros(len(layout))
        self._statistics = np.zeros(2)
        self._true_slopes = Direct(true_slopes)
        self._removed_modes = control.removed_modes
        self._configured_gain = float(control.options.centroid_gain)
        self.guard = Guard(control, layout)
        self.closed, self.opened_because = False, _AT_START
        self.closed_again_because = ""
        """Reason for which the guard had opened the loop before it closed it again; "" without."""
        self._flattened, self._begins, self._number = False, False, -1
        self._warm_up(len(layout))

    @property
    def _line(self) -> CommandDelayLine:
        """Delay line to the mirror."""
        return self._on.controller.line

    # The engine's thread ----------------------------------------------------------------------------

    def begin_product(self) -> Sequence[ProductPart]:
        """Return the product with the coming frame's slopes that may be begun while its rows arrive.

        Its parts are for the threads; there are none where nothing can be begun: the loop is open, the
        controller works otherwise, or modes are removed from the slopes, which needs all of them.
        """
        on = self._on
        parts: Sequence[ProductPart] = ()
        if not self.closed or self._begins or self._removed_modes:
            return parts
        try:
            parts = on.controller.begin_product(self._threads, 1.0 / on.centroid_gain)
        except Exception as error:  # nothing raises in the frame path
            self._fail(error)
        return parts

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
            slopes.covariance_xy,
            self._on.centroid_gain,
            self._slopes,
            self._errors,
            self._covariance,
            self._statistics,
        )
        if self._removed_modes:
            self._removed_modes.remove(slopes.flags, self._slopes, self._statistics)
        # The guard's limits do not depend on what a controller has learnt.
        self._statistics[MEAN_SQUARE] *= (self._on.centroid_gain / self._configured_gain) ** 2
        if self._flattened:
            self._flattened = False
            line.hold(np.zeros_like(line.latest))
        if self.closed:
            on = self._on
            on.controller.prior_std_px = prior_std_px if on.predicts else None
            self._update(on)
        else:
            line.put(line.latest)
        return line.latest

    def look_after(self, flux: NDArray[np.float32]) -> None:
        """Open the loop if the last frame shows a fault, or close it again, and predict the next frame.

        Parameters
        ----------
        flux : (n,) array
            Flux of that frame.
        """
        line, guard = self._line, self.guard
        frame = self._statistics, line.spare, flux
        if not self.closed:
            guard.watch(*frame)
            if guard.may_close_again:
                self._close_again()
        elif reason := guard.objection(*frame, line.latest):
            self.closed, self.opened_because = False, reason
            self._flattened = guard.flattens
        if self._successor is not None:
            self._let_follow(self._successor)
        self._expect()

    def _let_follow(self, successor: ControllerSuccessor) -> None:
        """Let a new controller follow the last frame, or take over if it has settled or the loop is open."""
        on, prior = self._on, self._prior
        if self.closed and not self._begins and successor.is_settling:
            std = on.controller.prior_std_px if prior is not None and on.controller.is_guarded else None
            mean = self._slopes if prior is None else prior.mean_px.reshape(-1).astype(np.float64)
            per_px = on.centroid_gain / successor.ready.centroid_gain
            covariance = per_px**2 * self._covariance
            successor.follow(self._line, per_px * self._slopes, per_px * self._errors, covariance, mean, std)
            return
        if self._successor is successor:  # else a newer one has come
            self._successor = None
        if successor.has_failed:
            return
        kind = successor.ready.kind
        if self.closed and on is self._ready[kind]:
            self._on = successor.take_over(self._line)
        self._ready[kind] = successor.ready

    def _close_again(self) -> None:
        """Close a loop that the guard has opened; a learnt controller leaves the mirror to its integrator."""
        reason = self.opened_because
        self._on.controller.fall_back()
        self.close()
        self.closed_again_because = reason

    def take_turn(self, kind: str | None) -> None:
        """Hand the coming frames to a controller; None: the configured one.

        It starts from the mirror's present commands if another controller had the frames before.
        """
        new = self._ready[self.control.options.controller if kind is None else kind]
        if new is self._on:
            return
        new.controller.line.copy_from(self._line)
        self._on = new
        self._expect(begins=self.closed and not self._begins)

    def _expect(self, *, begins: bool = False) -> None:
        """Give the estimators the prediction of the next frame by the controller, which may begin now."""
        prior, on = self._prior, self._on
        try:
            if begins:
                on.controller.begin()
            if self.closed and not self._begins:
                on.controller.complete()
                if prior is not None and on.predicts:
                    prior.expect(*on.controller.expected())
                    return
        except Exception as error:  # nothing raises in the frame path
            self._fail(error)
        if prior is not None:
            prior.forget()

    def _update(self, on: PreparedController) -> None:
        """Let a controller compute its command from the slopes."""
        try:
            if self._begins:
                self._begins = False
                on.controller.begin()
            on.controller.update(self._slopes, self._errors, self._covariance)
        except Exception as error:  # nothing raises in the frame path
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Open the loop because its controller failed; the mirror keeps the latest command."""
        self._line.hold(self._line.latest.copy())
        self.guard.end()
        self.closed, self.opened_because = False, f"the controller failed: {one_line(error)}"

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
        self._ready[kind] = PreparedController.of(self.control.with_controller(kind))

    def renew(self, model: Kalman) -> None:
        """Replace the model of a learnt controller.

        While the loop is closed, a new filter first follows it, see `ControllerSuccessor`.

        Raises
        ------
        InputError
            When the model is for another loop, or its commands are not finite.
        """
        ready = PreparedController.of(self.control.with_model(model))
        if ready.controller.is_guarded:
            self._successor = ControllerSuccessor(ready)
        else:
            self._ready[KALMAN] = ready
        self.control = replace(self.control, model=model)

    @property
    def controller(self) -> Controller:
        """Controller of the last frame."""
        return self._on.controller

    def close(self) -> None:
        """Close the loop, starting from the mirror's present commands; no effect if it is closed."""
        if self.closed:
            return
        self.guard.begin()
        self.opened_because = self.closed_again_because = ""
        self._begins = self.closed = True

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
            When no controller has a gain.
        """
        integrator = self._integrator
        if integrator is None:
            raise InputError(f"gain: the controller {self.control.options.controller!r} has no gain")
        integrator.gain = gain

    @property
    def _integrator(self) -> Controller | None:
        controllers = [ready.controller for ready in list(self._ready.values())]
        return next((made for made in controllers if made.gain is not None), None)

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
            "closed_again_because": (self.closed and self.closed_again_because) or None,
            "controller": self._on.kind,
            "commands": self.control.commands,
            **self.guard.status(),
            "latency": self.latencies.as_dict(),
        }

    def noted_state(self) -> dict[str, object]:
        """Return the state whose changes are written to telemetry."""
        return {
            "loop": self.state,
            "gain": self.gain,
            "opened_because": self.opened_because,
            "closed_again_because": self.closed_again_because,
        }

    def _warm_up(self, n: int) -> None:
        """Compile all controllers; the mirror's commands stay."""
        commands = self._line.latest.copy()
        self.closed = True
        self.follow(Slopes(*(np.zeros(n, kind) for kind in RESULT_TYPES)), -1)
        self.closed, self._begins = False, False
        self._line.hold(commands)
