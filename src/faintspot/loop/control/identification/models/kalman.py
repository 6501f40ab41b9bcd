"""Predictive Kalman filter of the open-loop slopes, of frozen flow where winds were found."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from faintspot.loop.control.base import Predictor
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.models.base import (
    COVARIANCE_PX2,
    ControlModel,
    Floats,
    Lesson,
    LoopPlant,
)
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.kalman.large_guarded import LargeGuarded
from faintspot.loop.control.kalman.local_covariance import STEPS
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_filter, local_shapes
from faintspot.loop.control.kalman.predictive import Predictive
from faintspot.loop.control.kalman.predictor import SlopePredictor, steady_covariance
from faintspot.loop.control.kalman.slope_model import SlopeModel
from faintspot.loop.control.telemetry import OpenLoopTelemetry, usual_noise

_MOST_SLOPES = 300  # whose filter lets each correct all others
_LAYERS = "first", "second", "driving_px2"
_NOISE = "variance_px2", "covariance_xy_px2"
_LOCAL = "near", "around", "weights", "corrections", "variance_px2", "predicted_px2", "share"
_ANY = -1e6, 1e6


@dataclass(frozen=True, eq=False)
class Kalman(ControlModel):
    """Filter of slopes: layers first, second, driving_px2 (layers, m, m), and the noise of slopes.

    The noise is variance_px2 (m,) and covariance_xy_px2 (m / 2,). For large sensors, in which only near
    sub-apertures interact, the arrays are those of `local_filter`.
    """

    kind = "kalman"
    label = "predictive Kalman filter"
    forms = {kind: (*_LAYERS, *_NOISE), "local kalman": _LOCAL}  # noqa: RUF012
    ranges = {  # noqa: RUF012
        **dict.fromkeys(("first", "second", "weights", "corrections"), _ANY),
        **dict.fromkeys(("driving_px2", "covariance_xy_px2"), COVARIANCE_PX2),
        "variance_px2": (1e-12, 1e8),
        "predicted_px2": (0.0, 1e8),
        "share": (0.0, 1.0),
    }
    predicts = True

    def learnt(self, lesson: Lesson) -> Kalman:
        """Return the filter of the turbulence that leaves least."""
        fits, done = lesson.fits(), itertools.count(1)
        total = len(fits) * sum(steps for _, steps in STEPS)

        def advance() -> None:
            if lesson.progress is not None:
                lesson.progress(next(done), total)

        def with_filter(model: Kalman, fit: Identified) -> Kalman:
            variance, covariance = usual_noise(lesson.telemetry.scaled(fit.noise_factor))
            if len(variance) > _MOST_SLOPES:
                arrays = local_filter(fit.layers, 1 / fit.rate_hz, variance, advance, covariance)
            else:
                slopes = fit.slope_model()
                values = slopes.first, slopes.second, slopes.driving, variance, covariance
                arrays = dict(zip((*_LAYERS, *_NOISE), values, strict=True))
            return replace(model, arrays=arrays).scored(lesson.plant, lesson.telemetry)

        return self.best_of(fits, with_filter)

    def controller(self, plant: LoopPlant, line: CommandDelayLine) -> Predictive:
        """Return the controller, in double precision."""
        filtered, clean = self.predictor(), plant.reconstructor.clean
        return Predictive(line, plant.interaction, filtered, clean, from_latest=self.is_local)

    def guarded(self, plant: LoopPlant, line: CommandDelayLine, **options: Any) -> GuardedController:
        """Return the compiled controller with the integrator beside it; options are those of the guard."""
        options = self.of_guard(options)
        if not self.is_local:
            return self._compiled(plant, line, self.phase(plant), **options)
        of_loop = plant.interaction, plant.reconstructor, self.phase_of_commands
        return LargeGuarded(line, *of_loop, self.arrays, self.plain_gain, plant.leak, **options)

    def _compiled(
        self, plant: LoopPlant, line: CommandDelayLine, phase: Floats, **options: Any
    ) -> CompiledKalman:
        reconstruct, clean = plant.reconstructor.matrix, plant.reconstructor.clean
        of_filter = phase, self.slope_predictor, clean, self.plain_gain, plant.leak
        return CompiledKalman(line, plant.interaction, reconstruct, *of_filter, **options)

    def replayed(self, plant: LoopPlant, telemetry: OpenLoopTelemetry, phase: Floats) -> Floats:
        """Return the squared residual that the filter would have left; see `replayed_frames`."""
        if self.is_local:
            return super().replayed(plant, telemetry, phase)
        line = CommandDelayLine(plant.interaction.shape[1], plant.delay_frames)
        return self._compiled(plant, line, phase, noise_factor=self.noise_factor).replayed(telemetry)

    def scored(self, plant: LoopPlant, telemetry: OpenLoopTelemetry) -> Kalman:
        """Return the filter with its residual on telemetry, and with the covariance that this needed."""
        scored = super().scored(plant, telemetry)
        return scored if self.is_local else replace(scored, covariance=self._covariance)

    @property
    def form(self) -> str:
        """Name in files."""
        dense, local = self.forms
        return local if self.is_local else dense

    @property
    def is_local(self) -> bool:
        """Whether it is a filter for large sensors, in which only near sub-apertures interact."""
        return "around" in self.arrays

    @property
    def expected_std_px(self) -> Floats:
        """(m,): standard deviations of the predicted slopes."""
        return self.predictor().std_px

    def predictor(self) -> Predictor:
        """Return the filter itself."""
        return LocalPredictor(self.arrays) if self.is_local else self.slope_predictor

    @property
    def slope_predictor(self) -> SlopePredictor:
        """Filter of a small sensor."""
        return SlopePredictor(self._slopes, *self._noise, covariance=self._covariance)

    def with_noise(self, scale: float) -> Kalman:
        """Return the filter with the noise variances scaled by a factor."""
        if scale == 1.0:
            return self
        arrays = self.arrays
        if not self.is_local:  # which has gains for several variances
            arrays = {**arrays, **{name: scale * arrays[name] for name in _NOISE}}
        text, factor = f"{self.description}, and {scale:g} of that", scale * self.noise_factor
        return replace(self, arrays=arrays, noise_factor=factor, description=text, covariance=None)

    @cached_property
    def _slopes(self) -> SlopeModel:
        return SlopeModel(*(self.arrays[name] for name in _LAYERS))

    @cached_property
    def _covariance(self) -> Floats:
        if self.covariance is not None:
            return self.covariance
        return steady_covariance(self._slopes, *self._noise)

    @property
    def _noise(self) -> tuple[Floats, Floats]:
        """Variances and covariances of the slopes' noise."""
        variance, covariance = (self.arrays[name] for name in _NOISE)
        return variance, covariance

    @classmethod
    def ranges_for(cls, plant: LoopPlant) -> dict[str, tuple[float, float]]:
        """Return the accepted ranges of its arrays for a loop."""
        return {**cls.ranges, **dict.fromkeys(("near", "around"), (0, len(plant.interaction) // 2))}

    @classmethod
    def shapes(cls, arrays: Mapping[str, Floats], plant: LoopPlant) -> dict[str, tuple[int, ...]]:
        """Return the shapes of its arrays for a loop."""
        slopes = len(plant.interaction)
        if "around" in arrays:
            return {"variance_px2": (slopes,), **local_shapes(arrays, slopes)}
        layers = len(arrays["first"]) if arrays["first"].ndim == 3 else 1
        of_layers = dict.fromkeys(_LAYERS, (layers, slopes, slopes))
        return {**of_layers, "variance_px2": (slopes,), "covariance_xy_px2": (slopes // 2,)}
