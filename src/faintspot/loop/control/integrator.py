"""Integrator with one gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import Controller, ExpectedSlopes
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.reconstructor import Reconstructor

Floats = NDArray[np.float64]


class Integrator(Controller):
    """Integrator with leak: subtracts a fraction of each frame's wavefront from the command.

    Parameters
    ----------
    line : CommandDelayLine
    interaction : (2 n, commands) array
        Slopes in px that a unit of each command adds.
    reconstructor : Reconstructor
    gain : float
        Loop gain.
    leak : float
        Part of the command that is forgotten in every frame, so that a loop that has lost the star returns.
    weighted : bool
        Whether slopes count by their standard errors and covariances.
    sees_mirror : bool
        Whether the sensor is behind the mirror. If not (open loop), the command follows the running mean of
        the wavefront.
    """

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        reconstructor: Reconstructor,
        gain: float,
        leak: float,
        *,
        weighted: bool = False,
        sees_mirror: bool = True,
    ) -> None:
        super().__init__(line, interaction)
        self._reconstructor, self._gain, self._leak = reconstructor, gain, leak
        self._weighted, self._sees_mirror = weighted, sees_mirror

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        if self._sees_mirror:
            return super().expected()
        return ExpectedSlopes(self._interaction @ -self.line.latest, None)

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        if self._weighted:
            wavefront = self._reconstructor.weighted(slopes_px, standard_error_px, covariance_xy_px2)
        else:
            wavefront = self._reconstructor(slopes_px)
        self.follow(wavefront)

    def follow(self, wavefront: Floats) -> None:
        """Update with this frame's wavefront, given as the commands that cause it."""
        forgotten = self._leak if self._sees_mirror else self._gain
        self.line.put((1 - forgotten) * self.line.latest - self._gain * wavefront)
