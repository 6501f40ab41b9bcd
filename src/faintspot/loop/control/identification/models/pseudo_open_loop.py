"""Pseudo-open-loop control: open-loop slopes are estimated, then corrected for the delay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from faintspot.loop.control.base import Controller
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.models.base import (
    COVARIANCE_PX2,
    ControlModel,
    Floats,
    Lesson,
    LoopPlant,
)
from faintspot.loop.control.kalman.predictive import PseudoOpenLoop

_GAINS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.65)
_COVARIANCES = "now_px2", "ahead_px2"


@dataclass(frozen=True, eq=False)
class PseudoOpenLoopModel(ControlModel):
    """Covariances (m, m) of open-loop slopes, now and with those of when the command acts; gain."""

    kind = "polc"
    label = "pseudo-open-loop control"
    forms = {kind: (*_COVARIANCES, "gain")}  # noqa: RUF012
    ranges = {**dict.fromkeys(_COVARIANCES, COVARIANCE_PX2), "gain": (0.0, 1.0)}  # noqa: RUF012

    def learnt(self, lesson: Lesson) -> PseudoOpenLoopModel:
        """Return the model for the turbulence and the gain that leave least."""
        plant, telemetry = lesson.plant, lesson.telemetry

        def with_best_gain(model: PseudoOpenLoopModel, fit: Identified) -> PseudoOpenLoopModel:
            covariances = fit.covariances_px2().sum(axis=0)
            arrays = {"now_px2": covariances[0], "ahead_px2": covariances[min(plant.delay_frames, 2)]}
            with_gains = [replace(model, arrays={**arrays, "gain": np.array(gain)}) for gain in _GAINS]
            return min((each.scored(plant, telemetry) for each in with_gains), key=lambda each: each.left[0])

        return self.best_of(lesson.fits(), with_best_gain)

    def controller(self, plant: LoopPlant, line: CommandDelayLine) -> Controller:
        """Return the controller."""
        covariances = self.arrays["now_px2"], self.arrays["ahead_px2"]
        gain = float(self.arrays["gain"])
        return PseudoOpenLoop(line, plant.interaction, *covariances, plant.reconstructor.clean, gain)

    @classmethod
    def shapes(cls, arrays: Mapping[str, Floats], plant: LoopPlant) -> dict[str, tuple[int, ...]]:
        """Return the shapes of its arrays for a loop."""
        slopes = len(plant.interaction)
        return dict.fromkeys(_COVARIANCES, (slopes, slopes))
