"""Guard of a closed loop, which detects when it must be opened, and controllers that take over."""

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control import integrator
from faintspot.loop.control.base import CommandDelayLine, Controller, without_prior
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.options import CONTROLLER
from faintspot.slopes.kernels.compiling import Direct
from faintspot.slopes.sensor.layout import Layout

_BEYOND_OPEN = 1.25  # times the open loop's slopes; a loop that leaves more makes things worse
_LARGEST_RESIDUAL = 0.25  # of a window's side, used if the open loop's slopes are not known
_MOST_OF_A_FRAME = 1 / 3  # of the limit: largest contribution of one frame, so that none decides alone
_LOST = 0.5  # of the flux
_MEMORY = 20  # times `guard_frames`
_FIRST = 0.2  # of `guard_frames`, after which a mean of the flux is a reference


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
        self._spots = LostSpots(control.interaction, options.guard_frames)
        self.flattens = False
        """Whether the mirror should be flattened, because its commands are at fault."""
        self._returns = False
        self._forget()
        self.begin()

    def begin(self) -> None:
        """Treat the loop as closed from now on; the open loop's slopes set the limit."""
        limit = self._options.largest_residual_px
        if limit is None and self._frames >= self._options.guard_frames:
            limit = _BEYOND_OPEN * self.residual_px
        self._largest_px = self._usual_px if limit is None else limit
        self._returns = False
        self._forget()

    def watch(self, summary: Floats, commands: Floats, flux: NDArray[np.float32]) -> None:
        """Take a frame: the summary of `true_slopes`, the commands that acted in it, and its flux (n,)."""
        self._frames += 1
        self._invalid += self._share * (summary.item(integrator.INVALID_PART) - self._invalid)
        most = self._largest_px**2 * max(2.0, _MOST_OF_A_FRAME / self._share)
        self._square += self._share * (min(summary.item(integrator.MEAN_SQUARE), most) - self._square)
        self._spots.take(commands, flux)

    def objection(self, summary: Floats, commands: Floats, flux: NDArray[np.float32], latest: Floats) -> str:
        """Take a frame of a closed loop; return why the loop must be opened, or "".

        A mean starts as if all earlier values had been 0, so that no single frame decides.

        Parameters
        ----------
        summary, commands, flux
            As for `watch`.
        latest : (commands,) array
            Commands computed from this frame.
        """
        self.watch(summary, commands, flux)
        options = self._options
        if options.largest_command is not None:
            at_limit = np.count_nonzero(np.abs(latest) >= options.largest_command) / len(latest)
            self._at_limit += self._share * (at_limit - self._at_limit)
        self.flattens = True
        if self._square > self._largest_px**2:
            rms = f"{math.sqrt(self._square):.2f} px rms, more than {self._largest_px:.2f}"
            return self._opened(f"diverged: slopes of {rms}")
        if self._at_limit > options.most_at_limit:
            parts = f"{100 * self._at_limit:.0f} % of the commands at their limit, more than"
            return self._opened(f"diverged: {parts} {100 * options.most_at_limit:g} %")
        if self._spots.lost:
            return self._opened(f"diverged: {self._spots.described()}")
        self.flattens = False
        if self._invalid > options.most_invalid:
            parts = f"{100 * self._invalid:.0f} % of the slopes not valid, more than"
            return self._opened(f"too low flux: {parts} {100 * options.most_invalid:g} %")
        return ""

    @property
    def may_close_again(self) -> bool:
        """Whether a loop that this guard has opened can be closed: it was proven, and slopes are valid."""
        options = self._options
        rested = self._returns and self._frames >= options.guard_frames
        return rested and self._invalid <= 0.5 * options.most_invalid

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

    def end(self) -> None:
        """Treat the loop as open, until it is closed by request."""
        self._returns = False
        self._forget()
        self._spots.forget()

    def _opened(self, reason: str) -> str:
        """Treat the loop as opened by this guard; return the reason."""
        frames, proven = self._frames, self._options.proven_frames
        self.end()
        self._returns = 0 < proven <= frames
        return reason

    def _forget(self) -> None:
        self._frames = 0
        self._invalid = self._square = self._at_limit = 0.0


class LostSpots:
    """Detector of spots that the mirror has moved out of the pixels that are measured.

    Slopes do not show such spots: an estimator that uses few pixels gives small slopes for them. Their flux
    does: it is low where and when the mirror displaces spots far, and is not otherwise. A star that fades is
    as faint in all sub-apertures and frames; in stronger turbulence the mirror displaces spots farther, but
    their flux remains. With the flux F of a sub-aperture in a frame, and the displacement d that the mirror
    adds to its spot, the spots are lost where mean(F d^2) < 0.5 mean(F) mean(d^2) in the long run, and the
    flux of late is below half of the largest that there was.

    Parameters
    ----------
    interaction : (2 n, commands) array
    frames : int
        Number of frames "of late"; the long run is 20 times as long.
    """

    def __init__(self, interaction: Floats, frames: int) -> None:
        self._columns = np.ascontiguousarray(interaction.T, np.float32)
        self._of_late, self._statistics = frames, np.zeros(3)
        self._work = tuple(np.zeros((1, side), np.float32) for side in self._columns.shape)
        self._summarise = Direct(integrator.displaced_flux)
        self.forget()
        self.take(np.zeros(interaction.shape[1]), np.zeros(len(interaction) // 2, np.float32))  # compiles
        self.forget()

    def forget(self) -> None:
        """Start again."""
        self._frames, self._late, self._largest = 0, 0.0, 0.0
        self._flux = self._displacement = self._product = 0.0

    def take(self, commands: Floats, flux: NDArray[np.float32]) -> None:
        """Take a frame: the commands that acted in it, and its flux (n,)."""
        self._summarise(commands, flux, self._columns, self._work, self._statistics)
        statistics = self._statistics
        flux_e = statistics.item(integrator.FLUX)
        self._frames += 1
        share = 1 / min(self._frames, _MEMORY * self._of_late)
        self._flux += share * (flux_e - self._flux)
        self._displacement += share * (statistics.item(integrator.DISPLACEMENT) - self._displacement)
        self._product += share * (statistics.item(integrator.FLUX_TIMES_DISPLACEMENT) - self._product)
        self._late += (flux_e - self._late) / min(self._frames, self._of_late)
        if self._frames >= _FIRST * self._of_late:
            self._largest = max(self._largest, self._late)

    @property
    def lost(self) -> bool:
        """Whether the mirror has moved spots away."""
        is_there = self._product >= _LOST * self._flux * self._displacement
        return not is_there and self._late < _LOST * self._largest

    def described(self) -> str:
        """Return what is wrong."""
        percent = 100 * self._late / self._largest
        return f"{percent:.0f} % of the flux left, as the mirror has moved spots away"


class PreparedController(NamedTuple):
    """A controller that has been prepared."""

    kind: str
    controller: Controller
    predicts: bool
    """Whether its prediction goes to the estimators as a prior."""
    centroid_gain: float
    """Centroid gain by which its slopes are divided."""

    @classmethod
    def of(cls, control: Control) -> Self:
        """Return the configured controller, with a delay line of its own.

        Raises
        ------
        InputError
            When its commands are not finite.
        """
        control.rehearse()
        # A learnt controller may not know its errors while its integrator is used.
        with np.errstate(all="ignore"):
            controller = control.controller(control.line())
        predicts = control.prediction == CONTROLLER
        return cls(control.options.controller, controller, predicts, control.centroid_gain)


class ControllerSuccessor:
    """Controller that follows the frames of a loop beside the controller that drives the mirror.

    Its own commands are sent nowhere: with each frame, its delay line is that of the mirror again. On large
    sensors a frame has no time for two filters: there the controller takes over at once.

    Parameters
    ----------
    ready : PreparedController
        With a guarded controller.
    """

    def __init__(self, ready: PreparedController) -> None:
        self.ready, self._frames = ready, 0
        self.has_failed = False

    @property
    def is_settling(self) -> bool:
        """Whether it has to follow more frames before it can take over."""
        return self._frames < self.ready.controller.settle_frames and not self.has_failed

    def follow(
        self,
        line: CommandDelayLine,
        slopes: Floats,
        errors: Floats,
        covariance: Floats,
        expected: Floats,
        prior: Floats | None,
    ) -> None:
        """Take a frame whose command has been sent.

        Parameters
        ----------
        line : CommandDelayLine
            To the mirror.
        slopes, errors, covariance : (2 n,), (2 n,) and (n,) arrays
            As for `Controller.update`, divided by this controller's centroid gain.
        expected, prior : (2 n,) array
            Mean and standard deviation of the estimator's prior; None: it had none.
        """
        alone, variance, _ = without_prior(slopes, errors, expected, prior)
        self.ready.controller.line.copy_from(line, without_latest=True)
        if self._frames == 0:
            self.ready.controller.begin()
        try:
            self.ready.controller.update(alone, np.sqrt(variance), covariance if prior is None else None)
        except ArithmeticError:
            self.has_failed = True
        self._frames += 1

    def take_over(self, line: CommandDelayLine) -> PreparedController:
        """Return the controller, whose commands go on from the mirror's."""
        self.ready.controller.line.copy_from(line)
        if self._frames == 0:
            self.ready.controller.begin()
        self.ready.controller.hand_over()
        return self.ready
