"""Values that are tuned of the methods that closed-loop experiments compare, and the usual methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.options import Option
from faintspot.experiments.methods import Choice
from faintspot.loop.control.base import INTEGRATOR, KALMAN
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import CLOSED
from faintspot.loop.simulation.methods import (
    FILTER,
    FOLLOWED,
    PREDICTED,
    PRIOR,
    UNCORRECTED,
    WEIGHTED,
    Method,
)
from faintspot.slopes.estimators.base import Need
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumAPosteriori
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.estimators.registry import estimators
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
    "window", "window+filter", "window+filter+followed", "ml+followed", "map+predicted+followed"
)  # fmt: skip
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


def tuned_values(method: Method, configuration: LoopConfiguration) -> dict[str, Tunable]:
    """Return what is tuned for a configuration's flux: the loop gain and options of the estimator."""
    estimator = method.estimator.for_scene(configuration.scene)
    declared = estimator.declared()
    options = {
        name: _wider(values, declared[name]) for name, values in estimator.tuned(configuration.scene).items()
    }
    if PRIOR in declared:
        reach = configuration.position_range_px(predicted=method.is_predicted)
        options[PRIOR] = [part * reach for part in _PRIORS]
    if method.control == KALMAN:
        options.pop(PRIOR, None)  # the filter knows it
    if FILTER in method.variants:
        options = {}  # the spots determine it
    tuned = {LOOP_GAIN: Tunable(_LOOP_GAINS, _FIRST_LOOP_GAINS)}
    if method.control != INTEGRATOR:
        tuned[LOOP_GAIN] = Tunable(_TELEMETRY_GAINS, _FIRST_TELEMETRY_GAINS)
    if method.control == KALMAN and estimator.takes_prior:
        tuned[NOISE_SCALE] = Tunable(_NOISE_SCALES, _FIRST_NOISE_SCALES)
    for number, (name, values) in enumerate(options.items()):
        tuned[name] = _spread(values, _FIRST_VALUES[min(number, len(_FIRST_VALUES) - 1)])
    return tuned


def with_choice(method: Method, configuration: LoopConfiguration, choice: Choice | None = None) -> Method:
    """Return a method with tuned values, for the configuration's own flux.

    Without a choice, options are automatic and the loop gain is the configuration's. The PSF of those that
    need one is that of a flat wavefront.

    Raises
    ------
    InputError
        When a value is missing, or the method needs a laser.
    """
    missing = [] if choice is None else [n for n in tuned_values(method, configuration) if n not in choice]
    if missing:
        raise InputError(f"choice: expected a value for {missing[0]!r} of the method {method.name!r}")
    options = dict(choice or {})
    gain, noise_scale = options.pop(LOOP_GAIN, None), float(options.pop(NOISE_SCALE, 1.0))
    estimator = method.estimator.for_scene(configuration.scene).replaced(options)
    laser, needs_psf = configuration.laser is not None, Need.PSF in estimator.required
    if not laser and {FILTER, FOLLOWED} & set(method.variants):
        raise InputError(f"method = {method.name!r}: expected a configuration with a laser")
    reach = configuration.position_range_px() if laser and needs_psf else None
    psf = _flat_psf(configuration) if needs_psf and not laser else None
    settings = Settings(estimator, search_range_px=reach)
    return replace(method, settings=settings, gain=gain, noise_scale=noise_scale, psf=psf)


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
        predicted = f"{name}+{PREDICTED}" if kind.takes_prior else name
        names += [predicted] if kind.takes_prior else []
        names += [f"{predicted}+{WEIGHTED}"] if Need.READ_NOISE in kind.needs else []
        if configuration.control.mode != CLOSED and not kind.needs:
            names.append(f"{name}+{UNCORRECTED}")
    kalman = [Window.name, MaximumAPosteriori.name] if configuration.control.mode == CLOSED else []
    return names + [f"{name}+{KALMAN}" for name in kalman]


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
