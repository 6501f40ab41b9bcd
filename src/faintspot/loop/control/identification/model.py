"""Models of controllers, which can be saved to a file, and the controllers made from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.npz import read_arrays, save_arrays
from faintspot.loop.control.base import SETTLE_FRAMES, Controller, Predictor
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.replay import mean_residual, replayed_frames, replayed_integrators
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.kalman.guarded import Guarded, GuardedController
from faintspot.loop.control.kalman.large_guarded import LargeGuarded
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_shapes
from faintspot.loop.control.kalman.predictive import Predictive, PseudoOpenLoop
from faintspot.loop.control.kalman.predictor import SlopePredictor, steady_covariance
from faintspot.loop.control.kalman.slope_model import SlopeModel
from faintspot.loop.control.reconstructor import Reconstructor
from faintspot.loop.control.telemetry import OpenLoopTelemetry

Floats = NDArray[np.float64]
Make = Callable[[CommandDelayLine], Controller]

INTEGRATOR, MODAL, POLC, KALMAN = "integrator", "modal", "polc", "kalman"
CONTROLS = {
    INTEGRATOR: "integrator with one gain",
    MODAL: "integrator with a gain for each mode",
    POLC: "pseudo-open-loop control",
    KALMAN: "predictive Kalman filter",
}
"""Kinds of control and their names in reports."""

_LOCAL = "local kalman"  # in files: KALMAN for a large sensor
_OF_KIND = {
    MODAL: ("gains",),
    POLC: ("now_px2", "ahead_px2", "gain"),
    KALMAN: ("first", "second", "driving_px2", "variance_px2", "covariance_xy_px2"),
    _LOCAL: ("near", "around", "weights", "corrections", "variance_px2", "predicted_px2", "share"),
}
_NOISE = "variance_px2", "covariance_xy_px2"
_SQUARE = {"now_px2", "ahead_px2"}
_OF_LAYERS = {"first", "second", "driving_px2"}
_OF_ALL = ("plain_gain", "noise_factor", "left", "phase_of_commands")
_GAIN = "centroid_gain"
_COVARIANCE = -1e8, 1e8  # px^2: of slopes of 1e4 px
_RANGES = {
    "gains": (0.0, 2.0),
    "gain": (0.0, 1.0),
    "plain_gain": (0.0, 2.0),
    "noise_factor": (1e-6, 1e6),
    _GAIN: (1e-3, 1e3),
    "variance_px2": (1e-12, 1e8),
    "now_px2": _COVARIANCE,
    "ahead_px2": _COVARIANCE,
    "driving_px2": _COVARIANCE,
    "covariance_xy_px2": _COVARIANCE,
    "predicted_px2": (0.0, 1e8),
    "share": (0.0, 1.0),
    "weights": (-1e6, 1e6),
    "corrections": (-1e6, 1e6),
    "first": (-1e6, 1e6),
    "second": (-1e6, 1e6),
}
"""Accepted range; other values are damaged or in another unit, and products may overflow."""


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

    def integrator(self, gain: float | Floats, line: CommandDelayLine) -> Controller:
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


@dataclass(frozen=True, eq=False)
class ControlModel:
    """Model of a controller, learnt from telemetry."""

    kind: str
    arrays: Mapping[str, Floats]
    """modal: gains (modes,). polc: now_px2 and ahead_px2 (m, m), gain. kalman: first, second and driving_px2
    (layers, m, m), variance_px2 (m,) and covariance_xy_px2 (m / 2,) of the slopes' noise; for large sensors
    those of `local_filter`."""
    plain_gain: float
    """Gain of the fallback integrator."""
    noise_factor: float
    """Factor on the variances of standard errors."""
    left: tuple[float, float]
    """Residual phase variance of the learnt and the plain controller on the telemetry, noise included."""
    phase_of_commands: Floats
    """(commands, commands): matrix of the measure that compares both; see `phase_of_commands`."""
    description: str = ""
    centroid_gain: float = 1.0
    """Centroid gain of the slopes, by which they are divided before they come to the controller."""
    covariance: Floats | None = None
    """(states, states) px^2: as from `steady_covariance`, where it is known already."""
    identified: Identified | None = None
    """Turbulence that the model follows from; None for modal gains and models read from a file."""

    def controller(self, plant: LoopPlant, line: CommandDelayLine) -> Controller:
        """Return the learnt controller."""
        arrays = self.arrays
        if self.kind == MODAL:
            return plant.integrator(arrays["gains"], line)
        clean = plant.reconstructor.clean
        if self.kind == POLC:
            covariances = arrays["now_px2"], arrays["ahead_px2"]
            return PseudoOpenLoop(line, plant.interaction, *covariances, clean, float(arrays["gain"]))
        return Predictive(line, plant.interaction, self.predictor(), clean, from_latest=self.is_local)

    def guarded(self, plant: LoopPlant, line: CommandDelayLine, **options: Any) -> GuardedController:
        """Return the learnt controller with the integrator beside it; options are those of the guard."""
        options |= {
            "noise_factor": self.noise_factor,
            "prefers_plain": self.left[1] < self.left[0],
            "plain_residual": self.left[1],
        }
        interaction, gain = plant.interaction, self.plain_gain
        if self.is_local:
            of_loop = interaction, plant.reconstructor, self.phase_of_commands
            return LargeGuarded(line, *of_loop, self.arrays, gain, plant.leak, **options)
        if self.kind == KALMAN:
            return self._compiled(plant, line, self.phase(plant), **options)
        learnt, plain = partial(self.controller, plant), partial(plant.integrator, gain)
        return Guarded(line, interaction, self.phase(plant), learnt, plain, **options)

    def _compiled(
        self, plant: LoopPlant, line: CommandDelayLine, phase: Floats, **options: Any
    ) -> CompiledKalman:
        reconstruct, clean = plant.reconstructor.matrix, plant.reconstructor.clean
        of_filter = phase, self.slope_predictor, clean, self.plain_gain, plant.leak
        return CompiledKalman(line, plant.interaction, reconstruct, *of_filter, **options)

    def replayed(self, plant: LoopPlant, telemetry: OpenLoopTelemetry, phase: Floats) -> Floats:
        """Return the squared residual that the learnt controller would have left; see `replayed_frames`."""
        if self.kind != KALMAN or self.is_local:
            scaled = telemetry.scaled(self.noise_factor)
            return plant.replayed(partial(self.controller, plant), scaled, phase)
        line = CommandDelayLine(plant.interaction.shape[1], plant.delay_frames)
        return self._compiled(plant, line, phase, noise_factor=self.noise_factor).replayed(telemetry)

    def phase(self, plant: LoopPlant) -> Floats:
        """Return the matrix (commands, m) from slopes to what is compared."""
        return np.asarray(self.phase_of_commands @ plant.reconstructor.matrix)

    def scored(self, plant: LoopPlant, telemetry: OpenLoopTelemetry) -> ControlModel:
        """Return the model with its residual on telemetry."""
        squares = self.replayed(plant, telemetry, self.phase(plant))
        residual = mean_residual(squares, telemetry, settled(telemetry))
        is_dense = self.kind == KALMAN and not self.is_local
        return replace(self, left=(residual, self.left[1]), covariance=self._covariance if is_dense else None)

    @property
    def is_local(self) -> bool:
        """Whether the Kalman filter is one for large sensors, in which only near sub-apertures interact."""
        return "around" in self.arrays

    @property
    def expected_std_px(self) -> Floats | None:
        """(m,): standard deviations of the predicted slopes; None if unknown."""
        return self.predictor().std_px if self.kind == KALMAN else None

    def predictor(self) -> Predictor:
        """Return the Kalman filter of the model."""
        return LocalPredictor(self.arrays) if self.is_local else self.slope_predictor

    @property
    def slope_predictor(self) -> SlopePredictor:
        """Kalman filter of a small sensor."""
        return SlopePredictor(self._slopes, *self._noise, covariance=self._covariance)

    def with_noise(self, scale: float) -> ControlModel:
        """Return the model of "kalman" with the noise variances scaled by a factor."""
        if scale == 1.0:
            return self
        arrays = self.arrays
        if not self.is_local:  # which has gains for several variances
            arrays = {**arrays, **{name: scale * arrays[name] for name in _NOISE}}
        text, factor = f"{self.description}, and {scale:g} of that", scale * self.noise_factor
        return replace(self, arrays=arrays, noise_factor=factor, description=text, covariance=None)

    @cached_property
    def _slopes(self) -> SlopeModel:
        return SlopeModel(*(self.arrays[name] for name in ("first", "second", "driving_px2")))

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

    def save(self, path: str | Path, others: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Write the model to a NumPy file (.npz), with other arrays beside it.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        numbers = {name: np.asarray(getattr(self, name), np.float64) for name in (*_OF_ALL, _GAIN)}
        kind = _LOCAL if self.is_local else self.kind
        save_arrays(path, {"kind": np.array(kind), **numbers, **self.arrays, **others})

    @classmethod
    def load(cls, path: str | Path, plant: LoopPlant) -> ControlModel:
        """Read a model for a loop.

        Raises
        ------
        InputError
            When it cannot be read, is for another loop, or has numbers out of range.
        """
        contents = "what control has learnt"
        kind = one_of("kind", str(read_arrays(path, contents, ("kind",))["kind"]), list(_OF_KIND))
        names = *_OF_ALL, *_OF_KIND[kind], _GAIN
        numbers = _checked(read_arrays(path, contents, names, optional=(_GAIN,)), plant)
        learnt, plain = numbers["left"]
        return cls(
            KALMAN if kind == _LOCAL else kind,
            {name: numbers[name] for name in _OF_KIND[kind]},
            float(numbers["plain_gain"]),
            float(numbers["noise_factor"]),
            (float(learnt), float(plain)),
            numbers["phase_of_commands"],
            centroid_gain=float(numbers.get(_GAIN, 1.0)),
        )

    def check(self, plant: LoopPlant) -> None:
        """Refuse a model of another loop, or with numbers out of range.

        Raises
        ------
        InputError
            One line.
        """
        numbers = {name: getattr(self, name) for name in (*_OF_ALL, _GAIN)}
        _checked({**self.arrays, **numbers}, plant)


def _checked(arrays: Mapping[str, Any], plant: LoopPlant) -> dict[str, Floats]:
    """Return a model's arrays as float64, with checked shapes and ranges."""
    (slopes, commands), modes = plant.interaction.shape, plant.reconstructor.modes.shape[1]
    ranges = {**_RANGES, "near": (0, slopes // 2), "around": (0, slopes // 2)}
    numbers = {name: numbers_between(name, value, *ranges.get(name, ())) for name, value in arrays.items()}
    shapes: dict[str, tuple[int, ...]] = {"gains": (modes,), "variance_px2": (slopes,), "left": (2,)}
    shapes["phase_of_commands"] = commands, commands
    shapes["covariance_xy_px2"] = (slopes // 2,)
    shapes |= dict.fromkeys(_SQUARE, (slopes, slopes))
    layers = len(numbers["first"]) if "first" in numbers and numbers["first"].ndim == 3 else 1
    shapes |= dict.fromkeys(_OF_LAYERS, (layers, slopes, slopes))
    if "around" in numbers:
        shapes |= local_shapes(numbers, slopes)
    for name, array in numbers.items():
        if array.shape != shapes.get(name, ()):
            raise InputError(f"{name}: expected shape {shapes.get(name, ())}, got {array.shape}")
    return numbers
