"""Error sources that a run switches off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import TRUE, Method


@dataclass(frozen=True)
class DisabledErrors:
    """Error sources that a run switches off, for error budgets; none by default."""

    noiseless: bool = False
    """Every pixel holds its mean flux."""
    true_slopes: bool = False
    """Whether slopes are the true mean gradients of the wavefront, for every method."""
    correctable: bool = False
    """Whether the turbulence is limited to what the mirror can correct."""
    faster: float = 1.0
    """Factor on the frame rate, with the same flux in each frame and the same duration."""
    exact_gain: bool = False
    """Whether slopes are divided by the centroid gain of a first run, for one method."""

    stretch_frames: ClassVar[int] = 100
    """Frames in each stretch of a faster loop."""
    stretch_settle_frames: ClassVar[int] = 40

    def configuration(self, configuration: LoopConfiguration) -> LoopConfiguration:
        """Return the configuration with a changed frame rate and the same flux per frame."""
        if self.faster == 1.0:
            return configuration
        rate = configuration.control.frame_rate_hz * self.faster
        camera = {"photons_per_subaperture": configuration.photons, "magnitude": None}
        return configuration.replace("camera", **camera).replace("control", frame_rate_hz=rate)

    def method(self, method: Method) -> Method:
        """Return the method as used in such a run."""
        return replace(method, variants=(*method.variants, TRUE)) if self.true_slopes else method

    def time_s(self, frame: int, frame_rate_hz: float) -> float:
        """Return the middle of a frame."""
        first = 0 if self.faster == 1.0 else frame - frame % self.stretch_frames
        return first * self.faster / frame_rate_hz + (frame - first + 0.5) / frame_rate_hz

    def settled(self, frames: int) -> NDArray[np.bool_]:
        """Return which frames directly follow the frame before, (frames,)."""
        position = np.arange(frames) % self.stretch_frames
        return (position >= self.stretch_settle_frames) | (self.faster == 1.0)
