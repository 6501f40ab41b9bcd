"""Model of a controller, which can be saved to a file, and the controllers made from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.npz import read_arrays, save_arrays
from faintspot.loop.control.base import SETTLE_FRAMES, Controller
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.replay import mean_residual, replayed_frames, replayed_integrators
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.reconstructor import Reconstructor
from faintspot.loop.control.telemetry import OpenLoopTelemetry

Floats = NDArray[np.float64]
Make = Callable[[CommandDelayLine], Controller]

_OF_ALL = ("plain_gain", "noise_factor", "left", "phase_of_commands")
_GAIN = "centroid_gain"
COVARIANCE_PX2 = -1e8, 1e8
"""Accepted range of covariances: those of slopes of 1e4 px."""
_RANGES = {"plain_gain": (0.0, 2.0), "noise_factor": (1e-6, 1e6), _GAIN: (1e-3, 1e3)}
_FORMS: dict[str, type[ControlModel]] = {}  # filled by the kinds themselves


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

    def integrator(self, gain: float, line: CommandDelayLine) -> Controller:
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
class Lesson:
    """What a controller learns from."""

    plant: LoopPlant
    telemetry: OpenLoopTelemetry
    """Frames by which controllers are compared."""
    fits: Callable[[], list[Identified]]
    """Returns the turbulence as identified from all frames, in one way or several."""
    progress: Callable[[int, int], None] | None = None
    """Called with the steps done and their number while filters of many slopes are computed."""


@dataclass(frozen=True, eq=False)
class ControlModel:
    """Model of a controller, learnt from telemetry; each kind is a subclass, in a module of its own."""

    kind: ClassVar[str]
    label: ClassVar[str]
    """Name in reports."""
    forms: ClassVar[Mapping[str, tuple[str, ...]]]
    """Names in files, and the arrays of each."""
    ranges: ClassVar[Mapping[str, tuple[float, float]]]
    """Accepted ranges of arrays; other values are damaged or in another unit, and products may overflow."""
    predicts: ClassVar[bool] = False
    """Whether it knows the slopes of the next frame and their errors, the prior of an estimator."""

    arrays: Mapping[str, Floats]
    """Those of its form in files."""
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
    """Turbulence that the model follows from; None for models read from a file."""

    def __init_subclass__(cls) -> None:
        _FORMS.update(dict.fromkeys(cls.forms, cls))

    def learnt(self, lesson: Lesson) -> Self:
        """Return the model with what it learns."""
        raise NotImplementedError

    def controller(self, plant: LoopPlant, line: CommandDelayLine) -> Controller:
        """Return the learnt controller."""
        raise NotImplementedError

    def guarded(self, plant: LoopPlant, line: CommandDelayLine, **options: Any) -> GuardedController:
        """Return the learnt controller with the integrator beside it; options are those of the guard."""
        raise NotImplementedError

    def of_guard(self, options: Mapping[str, object]) -> dict[str, Any]:
        """Return options of the guard with those that the model sets."""
        return {
            **options,
            "noise_factor": self.noise_factor,
            "prefers_plain": self.left[1] < self.left[0],
            "plain_residual": self.left[1],
        }

    def replayed(self, plant: LoopPlant, telemetry: OpenLoopTelemetry, phase: Floats) -> Floats:
        """Return the squared residual that the learnt controller would have left; see `replayed_frames`."""
        return plant.replayed(partial(self.controller, plant), telemetry.scaled(self.noise_factor), phase)

    def phase(self, plant: LoopPlant) -> Floats:
        """Return the matrix (commands, m) from slopes to what is compared."""
        return np.asarray(self.phase_of_commands @ plant.reconstructor.matrix)

    def scored(self, plant: LoopPlant, telemetry: OpenLoopTelemetry) -> Self:
        """Return the model with its residual on telemetry."""
        squares = self.replayed(plant, telemetry, self.phase(plant))
        residual = mean_residual(squares, telemetry, settled(telemetry))
        return replace(self, left=(residual, self.left[1]))

    def best_of(self, fits: Iterable[Identified], learn: Callable[[Self, Identified], Self]) -> Self:
        """Return what it learns from the turbulence that leaves least; `learn` scores."""
        models = []
        for fit in fits:
            text = f"{fit.summary()}, noise variance x {fit.noise_factor:.2f}"
            model = replace(self, noise_factor=fit.noise_factor, description=text)
            models.append(replace(learn(model, fit), identified=fit))
        return min(models, key=lambda model: model.left[0])

    def with_noise(self, scale: float) -> Self:
        """Return the model with the noise variances scaled by a factor, if it has any."""
        return self

    @property
    def form(self) -> str:
        """Name in files."""
        return next(iter(self.forms))

    @property
    def expected_std_px(self) -> Floats | None:
        """(m,): standard deviations of the predicted slopes; None if unknown."""
        return None

    def save(self, path: str | Path, others: Mapping[str, object] = MappingProxyType({})) -> None:
        """Write the model to a NumPy file (.npz), with other arrays beside it.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        numbers = {name: np.asarray(getattr(self, name), np.float64) for name in (*_OF_ALL, _GAIN)}
        save_arrays(path, {"kind": np.array(self.form), **numbers, **self.arrays, **others})

    @classmethod
    def load(cls, path: str | Path, plant: LoopPlant) -> Self:
        """Read a model for a loop.

        Raises
        ------
        InputError
            When it cannot be read, is of another kind or loop, or has numbers out of range.
        """
        contents = "what control has learnt"
        kinds = {form: kind for form, kind in _FORMS.items() if issubclass(kind, cls)}
        form = one_of("kind", str(read_arrays(path, contents, ("kind",))["kind"]), list(kinds))
        kind, own = kinds[form], kinds[form].forms[form]
        names = *_OF_ALL, *own, _GAIN
        numbers = kind._checked(read_arrays(path, contents, names, optional=(_GAIN,)), plant)
        learnt, plain = numbers["left"]
        return kind(
            {name: numbers[name] for name in own},
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
        self._checked({**self.arrays, **numbers}, plant)

    @classmethod
    def _checked(cls, arrays: Mapping[str, object], plant: LoopPlant) -> dict[str, Floats]:
        """Return a model's arrays as float64, with checked shapes and ranges."""
        ranges = {**_RANGES, **cls.ranges_for(plant)}
        numbers = {
            name: numbers_between(name, value, *ranges.get(name, ())) for name, value in arrays.items()
        }
        commands = plant.interaction.shape[1]
        shapes = {"left": (2,), "phase_of_commands": (commands, commands), **cls.shapes(numbers, plant)}
        for name, array in numbers.items():
            if array.shape != shapes.get(name, ()):
                raise InputError(f"{name}: expected shape {shapes.get(name, ())}, got {array.shape}")
        return numbers

    @classmethod
    def ranges_for(cls, plant: LoopPlant) -> Mapping[str, tuple[float, float]]:
        """Return the accepted ranges of its arrays for a loop."""
        return cls.ranges

    @classmethod
    def shapes(cls, arrays: Mapping[str, Floats], plant: LoopPlant) -> Mapping[str, tuple[int, ...]]:
        """Return the shapes of its arrays that are no numbers, for a loop."""
        raise NotImplementedError
