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
    """The slopes of the next frame before it is measured: an estimator's prior."""

    mean_px: Floats
    """(2 n,): residual slopes, after what the mirror will hold."""
    std_px: Floats | None
    """(2 n,): how sure that is; None where the controller does not know."""


class Controller(Protocol):
    """Takes the slopes of every frame and sends commands to the mirror.

    In every frame first `expected`, for those who want to know, then `update`. Slopes are residual ones, in
    true pixels from the reference, all x, then all y; a standard error that is infinite means that a slope
    was not measured.
    """

    @property
    def undoes_prior(self) -> bool:
        """Whether slopes are what the frame alone says; else as estimators give them, with their prior."""

    def expected(self) -> Expected:
        """Return what this frame's slopes are expected to be."""

    def begin(self) -> None:
        """Go on from what the mirror holds, of which the line tells; frames before are forgotten."""

    def update(self, slopes_px: Floats, standard_error_px: Floats) -> None:
        """Take this frame's slopes and send the command that follows from them."""
