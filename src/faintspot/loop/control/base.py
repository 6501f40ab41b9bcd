"""Interface of controllers and predictive filters; delay of commands; replay of open-loop slopes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.loop.control.reconstructor import LARGEST_CORRELATION, Reconstructor

if TYPE_CHECKING:
    from faintspot.slopes.kernels.products import ProductPart


class CommandDelayLine:
    """Delay line between controllers and mirror; all controllers of a mirror share it.

    Its memory is made once: what `acting` and `latest` return is good until the next command is sent.

    Parameters
    ----------
    commands : int
        Number of actuators.
    delay_frames : int
        The command computed from frame k acts first during frame k + delay_frames.
    largest : float or (commands,) array
        Stroke: no command is sent that is larger. What is cut off is forgotten, so that nothing winds up.
    """

    def __init__(self, commands: int, delay_frames: int, largest: ArrayLike = math.inf) -> None:
        self.delay_frames, self.largest = delay_frames, np.full(commands, largest, np.float64)
        self.rows = np.zeros((delay_frames + 1, commands))
        """(delay_frames + 1, commands): the latest commands."""
        self.next_row = 0
        """Row for the next command; the oldest other row acts."""
        self._rows = list(self.rows)

    @property
    def acting(self) -> Floats:
        """Commands that the mirror holds during this frame."""
        return self._rows[(self.next_row + 1) % len(self._rows)]

    @property
    def latest(self) -> Floats:
        """Last computed command, which may not act yet."""
        return self._rows[self.next_row - 1]

    @property
    def spare(self) -> Floats:
        """Row into which the next command may be written before `sent`.

        Until then it holds what the mirror held during the last frame.
        """
        return self._rows[self.next_row]

    def put(self, command: Floats) -> None:
        """Send a command, clipped to the stroke, and advance by one frame.

        Raises
        ------
        ArithmeticError
            See `sent`.
        """
        total = float(command.sum())
        np.clip(command, -self.largest, self.largest, out=self.spare)
        self.sent(total)

    def sent(self, total: float) -> None:
        """Send the command in `spare`, which is within the stroke, and advance by one frame.

        Parameters
        ----------
        total : float
            Sum of the command before it was clipped, which turns an infinite command into a finite one.

        Raises
        ------
        ArithmeticError
            When the sum is not finite. The latest command stays the latest.
        """
        if not math.isfinite(total):
            raise ArithmeticError("its commands were not finite")
        self.next_row = (self.next_row + 1) % len(self._rows)

    def copy_from(self, other: CommandDelayLine, *, without_latest: bool = False) -> None:
        """Take the commands of a line of the same length, perhaps as they were before its latest."""
        self.rows[:] = other.rows
        self.next_row = (other.next_row - without_latest) % len(self._rows)

    def hold(self, command: Floats) -> None:
        """Restart with a mirror that holds a command, and no delayed commands."""
        for row in self._rows:
            np.clip(command, -self.largest, self.largest, out=row)


INTEGRATOR, KALMAN = "integrator", "kalman"
CONTROLS = {INTEGRATOR: "integrator with one gain", KALMAN: "predictive Kalman filter"}
"""Kinds of control and their names in reports; only the Kalman filter learns and predicts slopes."""

LEARNT, ASSUMED, NONE = "learnt", "assumed", "none"
WINDS = LEARNT, ASSUMED, NONE
"""Winds of a predictive model: found in telemetry, given, or from all directions alike."""

SETTLE_FRAMES = 200
"""Frames after which a controller has settled; predictive filters take longer than integrators."""


def split_control(method: str) -> tuple[str, str]:
    """Split a method as recordings name it, "map+kalman"; either part is "" where the name lacks it."""
    measured, _, control = method.rpartition("+")
    is_split = control in CONTROLS and (measured or method == control)
    return (measured, control) if is_split else (method, "")


class ExpectedSlopes(NamedTuple):
    """Predicted slopes of the next frame, the prior of an estimator."""

    mean_px: Floats
    """(2 n,): residual slopes, with the commands that the mirror will hold."""
    std_px: Floats | None
    """(2 n,): standard deviations; None if the controller does not know them."""


class Controller:
    """Controller that turns the slopes of every frame into commands.

    In every frame first `expected`, for those who want to know, then `update`. Slopes are residual ones, in
    true pixels from the reference, all x, then all y; a standard error that is infinite means that a slope
    was not measured. Covariances of x and y of the sub-apertures, (n,), count where a controller says so.

    Parameters
    ----------
    line : CommandDelayLine
        To the mirror.
    interaction : (2 n, commands) array
        Slopes in px that a unit of each command adds.
    """

    undoes_prior: ClassVar[bool] = False
    """Whether the controller needs slopes without the estimator's prior."""
    is_guarded: ClassVar[bool] = False
    """Whether a plain controller stands beside a learnt one; slopes are then freed of `prior_std_px`."""
    settle_frames: ClassVar[int] = SETTLE_FRAMES
    """Frames that a new one follows a running loop before it takes over."""
    prior_std_px: Floats | None = None
    """(2 n,): prior of the estimator of the next slopes, whose mean is `expected`; None: it had none."""
    gain: float | None = None
    """Loop gain that may be changed between two frames; None: it has none."""

    def __init__(self, line: CommandDelayLine, interaction: Floats) -> None:
        self.line, self._interaction = line, interaction

    def expected(self) -> ExpectedSlopes:
        """Return the predicted slopes of this frame; here as if the latest command were right for it."""
        return ExpectedSlopes(self._interaction @ (self.line.acting - self.line.latest), None)

    def begin(self) -> None:
        """Restart from the commands on the delay line, without the memory of earlier frames."""

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """Compute a command from this frame's slopes and send it."""
        raise NotImplementedError

    def complete(self) -> None:
        """Do the part of a frame's work for which its command need not wait; else the next call does it."""

    def begin_product(self, threads: int, scale: float) -> Sequence[ProductPart]:
        """Return the parts of the next frame's product with its slopes; see `SlopeProduct.parts`.

        There are none where nothing can be begun while slopes are measured.
        """
        return ()

    def fall_back(self) -> None:
        """Let the plain controller drive the mirror until the learnt one leaves less, if there are two."""

    def hand_over(self) -> None:
        """Let the next commands follow on from the latest, which another controller has sent."""


class Predictor(Protocol):
    """Kalman filter that predicts open-loop slopes."""

    @property
    def mean_px(self) -> Floats:
        """(m,): predicted open-loop slopes of the next frame."""

    @property
    def std_px(self) -> Floats:
        """(m,): standard deviations of the prediction."""

    def ahead(self, frames: int) -> Floats:
        """Return (m,): the slopes predicted for a number of frames after the current one."""

    def begin(self, slopes_px: Floats) -> None:
        """Restart from constant open-loop slopes."""

    def correct(
        self, slopes_px: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """Update with the measured open-loop slopes of this frame; infinite variance: invalid.

        `covariance_xy_px2` (m / 2,) are covariances of the noise of x and y.
        """

    def advance(self) -> None:
        """Predict the next frame."""


LEAST_SHARE = 0.02  # of the prior's information, that a slope is taken to add at least

LEAST_VARIANCE_PX2 = 1e-8  # of slopes that are known without an error


@dataclass(frozen=True, eq=False)
class OpenLoopTelemetry:
    """Open-loop slopes of consecutive frames, with their noise and the estimator's weight on them."""

    open_loop_px: Floats
    """(frames, m): open-loop slopes; any finite value where not measured."""
    variance_px2: Floats
    """(frames, m): variance of their noise; infinite: not measured."""
    trust: Floats
    """(frames, m): part of a deviation from what was expected that the estimator gives: 1, of estimators with
    a prior less, where not measured 0."""
    covariance_xy_px2: Floats | None = None
    """(frames, m / 2): covariance of the noise of x and y, 0 where not measured; None: independent."""

    def __len__(self) -> int:
        return len(self.open_loop_px)

    def part(self, start: int, stop: int | None) -> OpenLoopTelemetry:
        """Return a selection of frames."""
        arrays = {name: array[start:stop] for name, array in vars(self).items() if array is not None}
        return replace(self, **arrays)

    @property
    def covariances_px2(self) -> Floats:
        """(frames, m / 2): covariance of the noise of x and y; 0 where they are independent."""
        if self.covariance_xy_px2 is None:
            return np.zeros((len(self), self.open_loop_px.shape[1] // 2))
        return self.covariance_xy_px2

    def scaled(self, noise_factor: float) -> OpenLoopTelemetry:
        """Return the same telemetry with the noise scaled."""
        covariance = self.covariances_px2 * noise_factor
        return replace(self, variance_px2=self.variance_px2 * noise_factor, covariance_xy_px2=covariance)


def without_prior(
    slopes_px: Floats, standard_error_px: Floats, expected_px: Floats, prior_std_px: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """Return slopes without the estimator's prior, their variances, and `Telemetry.trust`.

    A posterior's mean and variance s hold the prior of variance v, too; fed back to the filter that the
    prior came from, it would count twice. The frame alone has the variance 1 / (1 / s - 1 / v), at most
    v / 0.02 so that a posterior as wide as the prior stays harmless, and its slope is as much farther from
    the prior's mean as the prior has drawn it there (all Gaussian).
    """
    variance = np.maximum(np.square(standard_error_px), LEAST_VARIANCE_PX2)
    measured = np.isfinite(variance)
    if prior_std_px is None:
        return slopes_px, variance, measured.astype(np.float64)
    prior = np.square(prior_std_px)
    # Information of the frame in units of the prior's.
    share = np.maximum(prior / variance - 1, LEAST_SHARE)
    trust = np.where(measured, share / (1 + share), 0.0)
    alone = expected_px + (slopes_px - expected_px) * (1 + share) / share
    return alone, np.where(measured, prior / share, np.inf), trust


def usual_noise(telemetry: OpenLoopTelemetry) -> tuple[Floats, Floats]:
    """Return the noise that gives as much information as the frames do on average.

    Returns
    -------
    variance_px2, covariance_xy_px2 : (m,), (m / 2,) array
    """
    variance, covariance = telemetry.variance_px2, telemetry.covariances_px2
    x, y = np.split(variance, 2, axis=1)
    measured = np.isfinite(x) & np.isfinite(y)
    root = np.sqrt(np.where(measured, x, 1.0) * np.where(measured, y, 1.0))
    rho = np.where(measured, np.clip(covariance / root, -LARGEST_CORRELATION, LARGEST_CORRELATION), 0.0)
    rest = 1 - np.square(rho)
    information = np.where(np.isfinite(variance), 1 / (variance * np.tile(rest, (1, 2))), 0.0).mean(axis=0)
    of_x, of_y = np.split(np.maximum(information, 1e-6), 2)
    shared = (rho / (root * rest)).mean(axis=0)
    determinant = of_x * of_y - np.square(shared)
    return np.concatenate([of_y / determinant, of_x / determinant]), shared / determinant


def as_estimated(slopes_px: Floats, trust: Floats, controller: Controller) -> Floats:
    """Return the slopes that an estimator with a prior would have given a controller."""
    if controller.undoes_prior:
        return slopes_px
    expected = controller.expected().mean_px
    return np.asarray(expected + trust * (slopes_px - expected))


def replayed_frames(
    make: Callable[[CommandDelayLine], Controller],
    telemetry: OpenLoopTelemetry,
    interaction: Floats,
    phase: Floats,
    delay_frames: int,
) -> Floats:
    """Return the squared residual that a controller would have left on recorded frames, (frames,).

    Parameters
    ----------
    make : callable
        Returns the controller, given where its commands go.
    telemetry : OpenLoopTelemetry
    interaction : (m, commands) array
    phase : (k, m) array
        From slopes to what is scored, see `residual_phase`.
    delay_frames : int
    """
    line = CommandDelayLine(interaction.shape[1], delay_frames)
    controller = make(line)
    error, covariance = np.sqrt(telemetry.variance_px2), telemetry.covariances_px2
    residuals = np.zeros_like(telemetry.open_loop_px)
    with np.errstate(over="ignore", invalid="ignore"):  # the residual of an unstable loop overflows
        for frame, slopes in enumerate(telemetry.open_loop_px):
            residual = slopes + interaction @ line.acting
            trust = telemetry.trust[frame]
            residuals[frame] = trust * residual
            try:
                estimated = as_estimated(residual, trust, controller)
                controller.update(estimated, error[frame], covariance[frame])
            except ArithmeticError:  # its commands are not finite
                return np.full(len(residuals), np.inf)
        return np.asarray(np.square(residuals @ phase.T).sum(axis=1))


def replayed_integrators(
    gains: ArrayLike,
    telemetry: OpenLoopTelemetry,
    interaction: Floats,
    reconstructor: Reconstructor,
    phase: Floats,
    delay_frames: int,
    leak: float,
) -> Floats:
    """Return the squared residuals of integrators with several gains, (gains, frames).

    All gains are columns of the same products. Parameters are those of `replayed_frames` and `Integrator`.
    """
    gain = np.asarray(gains, np.float64)
    commands = np.zeros((interaction.shape[1], len(gain)))
    caused = [np.zeros((len(interaction), len(gain))) for _ in range(delay_frames)]  # by the latest commands
    squares = np.zeros((len(telemetry), len(gain)))
    with np.errstate(over="ignore", invalid="ignore"):  # the residual of an unstable loop overflows
        for frame, (slopes, trust) in enumerate(zip(telemetry.open_loop_px, telemetry.trust, strict=True)):
            acting, latest = caused[frame % delay_frames], caused[(frame - 1) % delay_frames]
            slopes_px = trust[:, None] * (slopes[:, None] + acting)
            squares[frame] = np.square(phase @ slopes_px).sum(axis=0)
            slopes_px += (1 - trust)[:, None] * (acting - latest)  # as an estimator with a prior would have
            commands = (1 - leak) * commands - gain * (reconstructor.matrix @ slopes_px)
            caused[frame % delay_frames] = interaction @ commands
        squares[:, ~np.isfinite(commands.sum(axis=0))] = np.inf
    return squares.T


def mean_residual(frames: Floats, telemetry: OpenLoopTelemetry, settle_frames: int) -> float:
    """Return the mean square residual of fully trusted slopes, once the loop has settled; or infinity.

    Parameters
    ----------
    frames : (frames,) array
        As from `replayed_frames`.
    telemetry : OpenLoopTelemetry
    settle_frames : int
        Frames at the start that are not scored.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(frames[settle_frames:].mean())
    share = np.square(telemetry.trust[settle_frames:]).mean()
    return float(mean / share) if np.isfinite(mean) and share > 0 else math.inf
