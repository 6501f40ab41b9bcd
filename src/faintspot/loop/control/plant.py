"""Loop for which controllers are made, and replays of recorded slopes in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import SETTLE_FRAMES, CommandDelayLine, Controller, OpenLoopTelemetry
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.control.reconstructor import Reconstructor
from faintspot.loop.control.replay import mean_residual, replayed_frames, replayed_integrators

Floats = NDArray[np.float64]
Make = Callable[[CommandDelayLine], Controller]


def settled(telemetry: OpenLoopTelemetry) -> int:
    """Return the number of frames at the start of a replay that are not scored."""
    return min(SETTLE_FRAMES, len(telemetry) // 3)


@dataclass(frozen=True, eq=False)
class LoopPlant:
    """Properties of the loop that a controller needs: matrices, delay, leak."""

    interaction: Floats
    """(m, commands): slopes [px] per unit of each command."""
    reconstructor: Reconstructor
    delay_frames: int
    leak: float

    def integrator(self, gain: float, line: CommandDelayLine) -> Integrator:
        """Return an integrator of this loop."""
        return Integrator(line, self.interaction, self.reconstructor, gain, self.leak)

    def replayed(self, make: Make, telemetry: OpenLoopTelemetry, phase: Floats) -> Floats:
        """Return the squared residual that a controller would have left; see `replayed_frames`."""
        return replayed_frames(make, telemetry, self.interaction, phase, self.delay_frames)

    def replayed_integrators(
        self, gains: Sequence[float], telemetry: OpenLoopTelemetry, phase: Floats
    ) -> Floats:
        """Return the squared residuals of integrators, (gains, frames)."""
        of_loop = self.interaction, self.reconstructor, phase, self.delay_frames, self.leak
        return replayed_integrators(gains, telemetry, *of_loop)

    def best_gain(
        self, gains: Sequence[float], telemetry: OpenLoopTelemetry, phase: Floats
    ) -> tuple[float, float]:
        """Return the gain of the integrator that leaves the least phase variance, and that variance."""
        residuals = self.replayed_integrators(gains, telemetry, phase)
        variances = [mean_residual(residual, telemetry, settled(telemetry)) for residual in residuals]
        best = int(np.argmin(variances))
        return gains[best], variances[best]

    def residual(self, make: Make, telemetry: OpenLoopTelemetry, phase: Floats) -> float:
        """Return the phase variance that a controller would have left; see `mean_residual`."""
        return mean_residual(self.replayed(make, telemetry, phase), telemetry, settled(telemetry))
