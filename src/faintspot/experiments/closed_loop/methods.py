"""Methods that closed-loop experiments compare: an estimator, and how the loop uses its slopes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from faintspot.base.checks import one_of
from faintspot.base.config.options import AUTO, Option
from faintspot.base.errors import InputError
from faintspot.experiments.methods import Choice
from faintspot.loop.control.base import CONTROLS, INTEGRATOR, KALMAN
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import CLOSED
from faintspot.loop.simulation.methods import PRIOR, Method
from faintspot.slopes.estimators.base import Estimator, Need
from faintspot.slopes.estimators.built_in.maximum_a_posteriori import MaximumAPosteriori
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.estimators.registry import estimator_named, estimators
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.psf import PSF, spot_psf

LOOP_GAIN = "loop_gain"
NOISE_SCALE = "noise_scale"
_NOISE_SCALES = (0.35, 0.6, 1.0)
_FIRST_NOISE_SCALES = (0.6,)
_LOOP_GAINS = (0.05, 0.07, 0.1, 0.13, 0.17, 0.22, 0.28, 0.35, 0.43, 0.52, 0.62, 0.73, 0.85)
_FIRST_LOOP_GAINS = (0.17, 0.35, 0.62)
# Of control that learns it is only the gain at which telemetry is taken, which takes long.
_TELEMETRY_GAINS = (0.05, 0.1, 0.2, 0.3, 0.4)
_FIRST_TELEMETRY_GAINS = (0.2,)
# How far spots are from where a prior expects them is the loop's to say: parts of their range.
_PRIORS = (0.1, 0.175, 0.25, 0.35, 0.5, 0.75)
_METHODS_OF_LASER = (
    "window",
    "window_filter",
    "window_filter_followed",
    "ml_followed",
    "map_predicted_followed",
)
_STEPS_BEYOND = 2  # in the ratio of an end to its neighbour
_FEWEST_TO_WIDEN = 4
_FIRST_VALUES = (3, 2)  # of a method's first option, and of each further one


@dataclass(frozen=True)
class Tunable:
    """Something of a method that is tuned."""

    values: tuple[Any, ...]
    """Allowed values, in order."""
    first: tuple[Any, ...]
    """Those of the first look."""

    def nearest(self, value: float) -> Tunable:
        """Return only the value that is nearest to another one."""
        near = min(self.values, key=lambda candidate: abs(candidate - value))
        return Tunable((near,), (near,))


@dataclass(frozen=True)
class Variant:
    """A variant of a method's use in a loop."""

    label: str
    changes: Mapping[str, bool]
    """Attributes of the `Method` that differ, by name."""


VARIANTS = {
    # What stays near the prediction has no gain of its own, and is measured without one.
    "_predicted": Variant("predicted", {"predict_prior": True, "correct_gain": False}),
    "_weighted": Variant("weighted reconstructor", {"weighted_reconstructor": True}),
    "_uncorrected": Variant("gain not corrected", {"correct_gain": False}),
    "_filter": Variant("matched filter", {"matched_weights": True}),
    "_followed": Variant("profile followed", {"follows_profile": True}),
}
"""By what follows the estimator's name in that of a method: "map_predicted_weighted"."""
_PREDICTED = "_predicted"
_OF_LASER = _FILTER, _FOLLOWED = "_filter", "_followed"
CONTROL_SIGN = "+"
"""Between a method's slopes and its control: "map+kalman"."""


@dataclass(frozen=True)
class MethodKind:
    """An estimator and what the loop does with it; values are still to be chosen."""

    estimator: type[Estimator]
    variants: tuple[str, ...] = ()
    """Variants, in the order of `VARIANTS`."""
    control: str = INTEGRATOR

    @property
    def name(self) -> str:
        """Name in commands and results."""
        implied = [_PREDICTED] if self.control == KALMAN else []
        variants = [variant for variant in self.variants if variant not in implied]
        slopes = "".join([self.estimator.name, *variants])
        return slopes if self.control == INTEGRATOR else f"{slopes}{CONTROL_SIGN}{self.control}"

    @property
    def is_predicted(self) -> bool:
        """Whether its prior is the loop's prediction."""
        return _PREDICTED in self.variants

    @property
    def label(self) -> str:
        """Name in reports."""
        parts = [self.estimator.label, *(VARIANTS[name].label for name in self.variants)]
        return ", ".join(parts if self.control == INTEGRATOR else [*parts, CONTROLS[self.control]])

    def tuned(self, configuration: LoopConfiguration) -> dict[str, Tunable]:
        """Return what is tuned for a configuration's flux: the loop gain and options of the estimator."""
        estimator = self._untuned(configuration)
        declared = estimator.declared()
        options = {
            name: _wider(values, declared[name])
            for name, values in estimator.tuned(configuration.scene).items()
        }
        if PRIOR in declared:
            reach = configuration.position_range_px(predicted=_PREDICTED in self.variants)
            options[PRIOR] = [part * reach for part in _PRIORS]
        if self.control == KALMAN:
            options.pop(PRIOR, None)  # the filter knows it
        if _FILTER in self.variants:
            options = {}  # the spots determine it
        tuned = {LOOP_GAIN: Tunable(_LOOP_GAINS, _FIRST_LOOP_GAINS)}
        if self.control != INTEGRATOR:
            tuned[LOOP_GAIN] = Tunable(_TELEMETRY_GAINS, _FIRST_TELEMETRY_GAINS)
        if self.control == KALMAN and self.estimator.takes_prior:
            tuned[NOISE_SCALE] = Tunable(_NOISE_SCALES, _FIRST_NOISE_SCALES)
        for number, (name, values) in enumerate(options.items()):
            tuned[name] = _spread(values, _FIRST_VALUES[min(number, len(_FIRST_VALUES) - 1)])
        return tuned

    def method(self, configuration: LoopConfiguration, choice: Choice | None = None) -> Method:
        """Return the method with tuned values, for the configuration's own flux.

        Without a choice, options are automatic and the loop gain is the configuration's.

        The PSF of those that need one is that of a flat wavefront.

        Raises
        ------
        InputError
            When a value is missing.
        """
        missing = [] if choice is None else [n for n in self.tuned(configuration) if n not in choice]
        if missing:
            raise InputError(f"choice: expected a value for {missing[0]!r} of the method {self.name!r}")
        choice = choice or {}
        loop_options = (LOOP_GAIN, NOISE_SCALE)
        options = {name: value for name, value in choice.items() if name not in loop_options}
        estimator = self._untuned(configuration).replaced(options)
        laser, needs_psf = configuration.laser is not None, Need.PSF in estimator.required
        if not laser and any(name in self.variants for name in _OF_LASER):
            raise InputError(f"method = {self.name!r}: expected a configuration with a laser")
        changes: dict[str, Any] = {
            key: value for name in self.variants for key, value in VARIANTS[name].changes.items()
        }
        return Method(
            self.label,
            Settings(
                estimator, search_range_px=configuration.position_range_px() if laser and needs_psf else None
            ),
            choice.get(LOOP_GAIN),
            control=self.control,
            noise_scale=float(choice.get(NOISE_SCALE, 1.0)),
            psf=_flat_psf(configuration) if needs_psf and not laser else None,
            **changes,
        )

    def _untuned(self, configuration: LoopConfiguration) -> Estimator:
        automatic = {name: AUTO for name, option in self.estimator.declared().items() if option.automatic}
        return self.estimator(**automatic).for_scene(configuration.scene)


def method_kind(name: str) -> MethodKind:
    """Return a method by its name: that of an estimator, of variants and of control, as "ml_weighted+kalman".

    With the Kalman filter, estimators that take a prior are given its prediction.

    Raises
    ------
    InputError
        For an unknown estimator or control, or a prediction for one that takes none.
    """
    slopes, _, control = name.partition(CONTROL_SIGN)
    control = one_of("control of the method", control or INTEGRATOR, list(CONTROLS))
    base, variants = slopes, set()
    while base not in estimators():
        ending = next((ending for ending in VARIANTS if base.endswith(ending)), None)
        if ending is None:
            break
        base = base.removesuffix(ending)
        variants.add(ending)
    try:
        estimator = estimator_named(base)
    except InputError as error:
        expected = f"{error.expected}; after it may follow {', '.join(VARIANTS)}"
        raise InputError(expected, name="method", value=error.value) from None
    if _PREDICTED in variants and not estimator.takes_prior:
        raise InputError(f"method = {name!r}: expected an estimator that takes a prior, {base!r} takes none")
    if _FILTER in variants and estimator is not Window:
        raise InputError(f"method = {name!r}: expected estimator {Window.name!r} for {_FILTER!r}")
    if control == KALMAN and estimator.takes_prior:
        variants.add(_PREDICTED)
    return MethodKind(estimator, tuple(variant for variant in VARIANTS if variant in variants), control)


def default_methods(configuration: LoopConfiguration) -> list[str]:
    """Return the names of the methods that are compared where none are asked for.

    Every estimator, as far as it suits; those that take a prior also with the loop's prediction, and those
    that weigh pixels by their noise also with a weighted reconstructor. In closed loop, the strongest usual
    estimator and the one that gains most from a prior also with the Kalman filter. In open loop, where an
    error of the centroid gain is not fed back, those that know nothing of the spot also without its
    correction.
    With a laser guide star, those that suit elongated spots, with the profile learnt before and followed.
    """
    if configuration.laser is not None:
        return list(_METHODS_OF_LASER)
    names = []
    for name, kind in estimators().items():
        names.append(name)
        predicted = f"{name}{_PREDICTED}" if kind.takes_prior else name
        names += [predicted] if kind.takes_prior else []
        names += [f"{predicted}_weighted"] if Need.READ_NOISE in kind.needs else []
        if configuration.control.mode != CLOSED and not kind.needs:
            names.append(f"{name}_uncorrected")
    kalman = [Window.name, MaximumAPosteriori.name] if configuration.control.mode == CLOSED else []
    return names + [f"{name}{CONTROL_SIGN}{KALMAN}" for name in kalman]


def _wider(values: Sequence[Any], option: Option) -> Sequence[Any]:
    """Return values with some beyond both ends: in loops the best may be beyond."""
    if option.choices or option.whole or len(values) < _FEWEST_TO_WIDEN or min(values) <= 0:
        return values
    low, below, *_ = ordered = sorted(set(values))
    *_, above, high = ordered
    for step in range(1, _STEPS_BEYOND + 1):
        ordered += [low * (low / below) ** step, high * (high / above) ** step]
    return [value for value in ordered if option.low < value <= option.high]


def _spread(values: Sequence[Any], count: int) -> Tunable:
    """Return values in their order, and some of them, evenly spread, for a first look."""
    ordered = sorted(set(values))
    if len(ordered) <= count:
        return Tunable(tuple(ordered), tuple(ordered))
    middles = (2 * np.arange(count) + 1) / (2 * count) * (len(ordered) - 1)
    return Tunable(tuple(ordered), tuple(ordered[int(position + 0.5)] for position in middles))


def _flat_psf(configuration: LoopConfiguration) -> PSF:
    sensor = configuration.sensor
    return spot_psf(configuration.spot_width_px / 2, sensor.spot_elongation, radius_px=sensor.pixels)
