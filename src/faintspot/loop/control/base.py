"""Interface of controllers."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEARNT, ASSUMED, NONE = "learnt", "assumed", "none"
WINDS = LEARNT, ASSUMED, NONE
"""Winds of a predictive model: found in telemetry, given, or from all directions alike."""


class Expected(NamedTuple):
    """Predicted slopes of the next frame, the prior of an estimator."""

    mean_px: Floats
    """(2 n,): residual slopes, with the commands that the mirror will hold."""
    std_px: Floats | None
    """(2 n,): standard deviations; None if the controller does not know them."""


class Controller(Protocol):
    """Controller that turns the slopes of every frame into commands.

    In every frame first `expected`, for those who want to know, then `update`. Slopes are residual ones, in
    true pixels from the reference, all x, then all y; a standard error that is infinite means that a slope
    was not measured. Covariances of x and y of the sub-apertures, (n,), count where a controller says so.
    """

    @property
    def undoes_prior(self) -> bool:
        """Whether the controller needs slopes without the estimator's prior."""

    def expected(self) -> Expected:
        """Return the predicted slopes of this frame."""

    def begin(self) -> None:
        """Restart from the commands on the delay line, without the memory of earlier frames."""

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """Compute a command from this frame's slopes and send it."""
