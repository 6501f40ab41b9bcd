"""Integrator with a gain for each mode of the mirror."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from faintspot.loop.control.base import Controller
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.compiled import CompiledIntegrator
from faintspot.loop.control.identification.models.base import ControlModel, Floats, Lesson, LoopPlant
from faintspot.loop.control.modal_gains import largest_stable_gain, modal_gains

_LARGEST_PART = 0.85  # of the gain at which a mode would be unstable where slopes are fully trusted


@dataclass(frozen=True, eq=False)
class Modal(ControlModel):
    """Gains of the modes, (modes,)."""

    kind = "modal"
    label = "integrator with a gain for each mode"
    forms = {kind: ("gains",)}  # noqa: RUF012
    ranges = {"gains": (0.0, 2.0)}  # noqa: RUF012
    needs_errors = False
    integrates = True

    def learnt(self, lesson: Lesson) -> Modal:
        """Return the model with one gain per mode."""
        plant, telemetry = lesson.plant, lesson.telemetry
        trust = max(float(telemetry.trust.mean()), 1e-6)  # by which slopes are smaller than they should be
        weighted = telemetry.trust * telemetry.open_loop_px / trust
        modes = weighted @ plant.reconstructor.matrix.T @ plant.reconstructor.modes
        gains = modal_gains(modes, plant.delay_frames, plant.leak) / trust
        gains = np.minimum(gains, _LARGEST_PART * largest_stable_gain(plant.delay_frames))
        text = f"gains {gains.min():g} to {gains.max():g}"
        return replace(self, arrays={"gains": gains}, description=text).scored(plant, telemetry)

    def controller(self, plant: LoopPlant, line: CommandDelayLine) -> Controller:
        """Return the integrator with these gains."""
        return plant.integrator(self.arrays["gains"], line)

    def running(self, plant: LoopPlant, line: CommandDelayLine) -> Controller:
        """Return the same as compiled code, whose gains are part of its matrix."""
        modes = plant.reconstructor.modes
        matrix = (modes * self.arrays["gains"]) @ modes.T @ plant.reconstructor.matrix
        return CompiledIntegrator(line, plant.interaction, matrix, 1.0, plant.leak)

    @classmethod
    def shapes(cls, arrays: Mapping[str, Floats], plant: LoopPlant) -> dict[str, tuple[int, ...]]:
        """Return the shapes of its arrays for a loop."""
        return {"gains": (plant.reconstructor.modes.shape[1],)}
