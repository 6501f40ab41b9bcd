"""Methods that closed-loop experiments compare and tune; their results, files, and differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import finite_array
from faintspot.base.errors import InputError
from faintspot.base.files import NpzFile
from faintspot.base.options import Option
from faintspot.base.statistics import DRAWS, FEWEST_PIECES, SEED, UNKNOWN, Estimate, of_draws, paired_mean
from faintspot.experiments.methods import Choice, crossings
from faintspot.loop.control.base import INTEGRATOR, KALMAN
from faintspot.loop.simulation import methods
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.sections import CLOSED
from faintspot.slopes.estimators.base import Need
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumAPosteriori
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.estimators.registry import estimators
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.psf import PSF, spot_psf

_STREHL_LEVELS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)

LOOP_GAIN = "loop_gain"
NOISE_SCALE = "noise_scale"
# How far spots are from where a prior expects them is the loop's to say: parts of their range.
_PRIORS = (0.1, 0.175, 0.25, 0.35, 0.5, 0.75)
_STEPS_BEYOND = 2  # in the ratio of an end to its neighbour
_FEWEST_TO_WIDEN = 4
_FIRST_VALUES = (3, 2)  # of a method's first option, and of each further one


def magnitude_limit(magnitudes: ArrayLike, strehl: ArrayLike, level: float) -> Estimate:
    """Return the limiting magnitude at a Strehl ratio; parameters are those of `magnitude_gain`."""
    return _limit(*_complete(magnitudes, strehl), level)


def magnitude_gain(magnitudes: ArrayLike, strehl: ArrayLike, reference: ArrayLike, level: float) -> Estimate:
    """Return the gain in limiting magnitude at a Strehl ratio, with its interval over realisations.

    Each method's mean curve is made to fall with magnitude (isotonic regression) and interpolated by a
    monotone cubic between its points, never beyond them. Realisations are drawn with replacement, the same
    ones for both methods. Curves that bend alike are wrong alike: the error of interpolation, which widens
    the interval, is the change that straight lines make to the gain.

    Parameters
    ----------
    magnitudes : (F,) array
    strehl, reference : (F, R) arrays
        Of the method and of what it is compared with; the same realisations. NaN: not measured.
    level : float
        The Strehl ratio.

    Returns
    -------
    Estimate
        Infinite where the method's curve stays above the level and the reference's does not, minus infinite
        where it stays below; NaN where neither crosses it, or nothing is measured yet. An end of the interval
        is infinite where more than 2.5 % of the draws left the measured magnitudes there.

    Raises
    ------
    InputError
        When shapes do not fit together.
    """
    return _limit(*_complete(magnitudes, strehl, reference), level)


def _complete(magnitudes: ArrayLike, *strehl: ArrayLike) -> tuple[Floats, list[Floats]]:
    """Return magnitudes that all curves (F, R) were measured at, rising, and the curves."""
    faint = finite_array("magnitudes", magnitudes).astype(np.float64)
    curves = [np.asarray(values, np.float64) for values in strehl]
    if faint.ndim != 1 or any(curve.ndim != 2 or curve.shape != curves[0].shape for curve in curves):
        raise InputError("strehl, reference: expected the same shape (magnitudes, realisations)")
    if len(curves[0]) != len(faint):
        raise InputError(f"strehl: expected {len(faint)} magnitudes, got {len(curves[0])}")
    complete = ~np.isnan(sum(curves)).any(axis=1)
    order = np.flatnonzero(complete)[np.argsort(faint[complete])]
    return faint[order], [curve[order] for curve in curves]


def _limit(faint: Floats, curves: list[Floats], level: float) -> Estimate:
    """Return the limit of one curve, or the difference of those of two."""
    if len(faint) < 2:
        return UNKNOWN

    def read_off(*, straight: bool) -> float:
        found = (crossings(faint, falling(curve.mean(axis=1)), level, straight=straight) for curve in curves)
        first, *others = map(float, found)
        return first - sum(others)

    value, realisations = read_off(straight=False), curves[0].shape[1]
    if not math.isfinite(value) or realisations < FEWEST_PIECES:
        return Estimate(value)
    between = abs(read_off(straight=True) - value)
    if len(faint) == 2:  # no bend is seen: each curve may cross anywhere between the two
        between = math.sqrt(len(curves) / 12) * float(faint[1] - faint[0])
    draws = np.random.default_rng(SEED).integers(0, realisations, (DRAWS, realisations))
    ends = [crossings(faint, falling(curve[:, draws].mean(axis=2).T), level) for curve in curves]
    drawn = ends[0] if len(ends) == 1 else _differences(*ends)
    return of_draws(value, drawn, realisations).widened(between)


def falling(values: ArrayLike) -> Floats:
    """Return the never rising series (..., F) nearest to `values` by least squares.

    By the min-max formula: at each place, the least over all beginnings before it of the largest over all
    ends after it of the mean between them (Robertson, Wright & Dykstra 1988, Order Restricted Statistical
    Inference, chapter 1).
    """
    series = np.asarray(values, np.float64)
    count = series.shape[-1]
    sums = np.concatenate([np.zeros((*series.shape[:-1], 1)), np.cumsum(series, axis=-1)], axis=-1)
    index = np.arange(count)
    lengths = index[None, :] + 1 - index[:, None]  # from begin (rows) to end (columns)
    means = (sums[..., None, 1:] - sums[..., :-1, None]) / np.maximum(lengths, 1)
    means = np.where(lengths > 0, means, -np.inf)
    largest = np.maximum.accumulate(means[..., ::-1], axis=-1)[..., ::-1]  # over ends at or after the column
    return np.asarray(np.where(lengths > 0, largest, np.inf).min(axis=-2), np.float64)


def _differences(ends: Floats, starts: Floats) -> Floats:
    """Return ends - starts; which of two infinite ones is fainter is not known, and they count as equal."""
    same = np.isinf(ends) & (ends == starts)
    return np.asarray(np.where(same, 0.0, ends) - np.where(same, 0.0, starts), np.float64)


@dataclass(frozen=True, eq=False)
class MagnitudeResult(NpzFile):
    """Strehl ratio against the star's flux: A methods, F fluxes, R realisations of the air."""

    WHAT: ClassVar[str] = "a magnitude experiment"
    FORMAT: ClassVar[int] = 4

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.loop.simulation.Method.named`."""
    labels: tuple[str, ...]
    """(A,)"""
    photons: Floats
    """(F,): photo-electrons of a fully lit sub-aperture in a frame."""
    magnitudes: Floats
    """(F,)"""
    strehl: Floats
    """(A, F, R): long exposure; NaN where not measured yet."""
    centroid_gain: Floats
    """(A, F, R)"""
    settings: NDArray[np.str_]
    """(A, F): TOML text of the tuned settings; "" where not tuned yet."""
    choices: NDArray[np.str_]
    """(A, F): JSON text of the tuned values, loop gain included; "{}" where not tuned yet."""
    configuration: str
    """TOML text."""


def differences_by_flux(result: MagnitudeResult, method: int, reference: int) -> list[Estimate]:
    """Return a method's Strehl less the reference's at each flux, over realisations.

    The intervals hold together, for all fluxes, with 95 %.
    """
    fluxes = len(result.photons)
    return [
        paired_mean(result.strehl[method, f] - result.strehl[reference, f], fluxes) for f in range(fluxes)
    ]


def gains_in_magnitude(result: MagnitudeResult, method: int, reference: int) -> dict[float, Estimate]:
    """Return the gain in limiting magnitude at each Strehl ratio that the reference's curve passes."""
    curve = np.array([paired_mean(values).value for values in result.strehl[reference]])
    finite = curve[np.isfinite(curve)]
    return {
        level: magnitude_gain(result.magnitudes, result.strehl[method], result.strehl[reference], level)
        for level in _STREHL_LEVELS
        if len(finite) and finite.min() < level <= finite.max()
    }


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


_NOISE_SCALES = Tunable((0.35, 0.6, 1.0), (0.6,))
_LOOP_GAINS = Tunable(
    (0.05, 0.07, 0.1, 0.13, 0.17, 0.22, 0.28, 0.35, 0.43, 0.52, 0.62, 0.73, 0.85), (0.17, 0.35, 0.62)
)
# Of control that learns it is only the gain at which telemetry is taken, which takes long.
_TELEMETRY_GAINS = Tunable((0.05, 0.1, 0.2, 0.3, 0.4), (0.2,))


def tuned_values(method: methods.Method, configuration: LoopConfiguration) -> dict[str, Tunable]:
    """Return what is tuned for a configuration's flux: the loop gain and options of the estimator."""
    estimator = method.estimator.for_scene(configuration.scene)
    declared = estimator.declared()
    options = {
        name: _wider(values, declared[name]) for name, values in estimator.tuned(configuration.scene).items()
    }
    if methods.PRIOR in declared:
        reach = configuration.position_range_px(predicted=method.is_predicted)
        options[methods.PRIOR] = [part * reach for part in _PRIORS]
    if method.control == KALMAN:
        options.pop(methods.PRIOR, None)  # the filter knows it
    tuned = {LOOP_GAIN: _LOOP_GAINS if method.control == INTEGRATOR else _TELEMETRY_GAINS}
    if method.control == KALMAN and estimator.takes_prior:
        tuned[NOISE_SCALE] = _NOISE_SCALES
    for number, (name, values) in enumerate(options.items()):
        tuned[name] = _spread(values, _FIRST_VALUES[min(number, len(_FIRST_VALUES) - 1)])
    return tuned


def with_choice(
    method: methods.Method, configuration: LoopConfiguration, choice: Choice | None = None
) -> methods.Method:
    """Return a method with tuned values, for the configuration's own flux.

    Without a choice, options are automatic and the loop gain is the configuration's. The PSF of those that
    need one is that of a flat wavefront.

    Raises
    ------
    InputError
        When a value is missing.
    """
    missing = [] if choice is None else [n for n in tuned_values(method, configuration) if n not in choice]
    if missing:
        raise InputError(f"choice: expected a value for {missing[0]!r} of the method {method.name!r}")
    options = dict(choice or {})
    gain, noise_scale = options.pop(LOOP_GAIN, None), float(options.pop(NOISE_SCALE, 1.0))
    estimator = method.estimator.for_scene(configuration.scene).replaced(options)
    psf = _flat_psf(configuration) if Need.PSF in estimator.required else None
    return replace(method, settings=Settings(estimator), gain=gain, noise_scale=noise_scale, psf=psf)


def default_methods(configuration: LoopConfiguration) -> list[str]:
    """Return the names of the methods that are compared where none are asked for.

    Every estimator, as far as it suits; those that take a prior also with the loop's prediction, and those
    that weigh pixels by their noise also with a weighted reconstructor. In closed loop, the strongest usual
    estimator and the one that gains most from a prior also with the Kalman filter. In open loop, where an
    error of the centroid gain is not fed back, those that know nothing of the spot also without its
    correction.
    """
    names = []
    for name, kind in estimators().items():
        names.append(name)
        predicted = f"{name}+{methods.PREDICTED}" if kind.takes_prior else name
        names += [predicted] if kind.takes_prior else []
        names += [f"{predicted}+{methods.WEIGHTED}"] if Need.READ_NOISE in kind.needs else []
        if configuration.control.mode != CLOSED and not kind.needs:
            names.append(f"{name}+{methods.UNCORRECTED}")
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
    ordered = tuple(sorted(set(values)))
    if len(ordered) <= count:
        return Tunable(ordered, ordered)
    middles = (2 * np.arange(count) + 1) / (2 * count) * (len(ordered) - 1)
    return Tunable(ordered, tuple(ordered[int(position + 0.5)] for position in middles))


def _flat_psf(configuration: LoopConfiguration) -> PSF:
    sensor = configuration.sensor
    return spot_psf(configuration.spot_width_px / 2, sensor.spot_elongation, radius_px=sensor.pixels)
