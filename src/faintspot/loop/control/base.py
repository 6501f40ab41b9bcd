"""Interface of controllers and of the filters with which they predict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.commands import CommandDelayLine

if TYPE_CHECKING:
    from faintspot.slopes.kernels.driver.products import ProductPart

Floats = NDArray[np.float64]

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
