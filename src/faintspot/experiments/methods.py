"""Methods for spots of a scene, what they know, and the methods of studies by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.options import AUTO
from faintspot.base.statistics import slope_statistics
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.estimators.base import Estimator, Need, Style
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels, KeepingBrightest, Thresholded
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.registry import estimators
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.psf import PSF

_ROUNDS = 2  # of looking along each axis in turn

Choice = Mapping[str, Any]
"""Values of what is tuned, by name: options of the estimator and, in a closed loop, `LOOP_GAIN`."""
Axes = Mapping[str, Sequence[Any]]
"""Values of each option; the usual one first."""


class Knowledge(IntEnum):
    """Knowledge that an estimator needs beside the noise; larger is more."""

    NOISE = 0
    WIDTH = 1
    SPOT = 2

    @classmethod
    def of(cls, estimator: Estimator | type[Estimator]) -> Knowledge:
        """Return what follows from an estimator's needs."""
        if Need.PSF in estimator.needs:
            return cls.SPOT
        return cls.WIDTH if Need.WIDTH in estimator.needs else cls.NOISE


def method_for_scene(kind: type[Estimator], scene: Scene, *, psf: PSF | None = None) -> Method:
    """Return an estimator with the options that a scene asks for, before any are tuned.

    Parameters
    ----------
    kind : type of Estimator
    scene : Scene
        Its range of positions is the search range.
    psf : PSF, optional
        Ignored by an estimator that needs none.

    Raises
    ------
    InputError
        When an option that it cannot do without is neither automatic nor found in the scene.
    """
    automatic = {name: AUTO for name, option in kind.declared().items() if option.automatic}
    estimator = kind(**automatic).for_scene(scene)
    usual = {name: values[0] for name, values in estimator.tuned(scene).items()}
    width = {"spot_fwhm_px": scene.seen_fwhm_px} if Need.WIDTH in kind.needs else {}
    settings = Settings(
        estimator.replaced(_rounded({**estimator.chosen(), **usual})),
        search_range_px=scene.position_range_px,
        **_rounded(width),
    )
    return Method(kind.label, settings, psf=psf if Need.PSF in kind.needs else None)


def tuned_options(method: Method, scene: Scene) -> dict[str, list[object]]:
    """Return what a method may choose from in a scene; the usual value of each option is the first."""
    return {
        name: list(dict.fromkeys(_rounded(dict(enumerate(values))).values()))
        for name, values in method.estimator.tuned(scene).items()
    }


def _rounded(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return numbers to three digits: what is written is what was measured."""
    return {
        key: float(f"{value:.3g}") if isinstance(value, float) else value for key, value in values.items()
    }


Kind = type[Estimator]

TV, NO_TV, SMOOTHING = TotalVariation.name, BrightestPixels.name, Smoothed.name
"""The methods that the paper's claims compare, and the simplest rival."""
TV_OVER_NO_TV = {"method": TV, "reference": NO_TV}
"""Curves between which gains are computed."""

DEFAULT_METHODS = tuple(kind.name for kind in (BrightestPixels, TotalVariation, Smoothed, Thresholded))
"""The built-in ones that know nothing of the spot."""


def label_of(method: str) -> str:
    """Return what tables and figures call a method; its name where its estimator is not installed here."""
    return estimators()[method].label if method in estimators() else method


def style_of(method: str) -> Style:
    """Return how figures draw a method."""
    return estimators().get(method, Estimator).style


def knows_the_spot(method: str) -> bool:
    """Return whether a method knows more than the noise."""
    return method in estimators() and Knowledge.of(estimators()[method]) > Knowledge.NOISE


def keeps_every_k(kind: Kind) -> bool:
    """Whether all numbers of kept pixels are measured at once: its denoised images are known."""
    return issubclass(kind, KeepingBrightest) and kind.denoised is not KeepingBrightest.denoised


def coordinate_search(axes: Axes, badness: Callable[[Choice, str, Sequence[Any]], Sequence[float]]) -> Choice:
    """Look along each axis in turn, from the first values, and again along those for which others changed.

    Parameters
    ----------
    axes : mapping
    badness : callable
        Called with a choice, the name of an option and values of it; returns how bad the choice is with each
        of them.

    Returns
    -------
    dict
        The choice where the search ends.
    """
    best: Choice = {name: values[0] for name, values in axes.items()}
    looked: dict[str, Choice] = {}
    for name in list(axes) * (_ROUNDS if len(axes) > 1 else 1):
        fixed = {key: value for key, value in best.items() if key != name}
        if looked.get(name) != fixed:  # else nothing has changed since
            looked[name] = fixed
            best = {**best, name: axes[name][int(np.argmin(badness(best, name, axes[name])))]}
    return best


def corrected_badness(x: ArrayLike, y: ArrayLike, truth: ArrayLike) -> float:
    """Return the gain-corrected rms; where nothing is measured, the rms, behind all that measure."""
    statistics = slope_statistics(x, y, truth)
    corrected = statistics.corrected_rms.value
    return corrected if math.isfinite(corrected) else 1e6 + statistics.rms.value


_SAME = 1e-9  # difference of a level from the end of a curve that rounding makes
_HALVINGS = 50  # of the interval in which a curve crosses the level


def crossings(places: Floats, curves: Floats, level: ArrayLike, *, straight: bool = False) -> Floats:
    """Return where falling curves reach a level, (...).

    Infinite when a curve stays above within the places, minus infinite when it is never above.

    Parameters
    ----------
    places : (n,) array
        Rising.
    curves : (..., n) array
        Values there, which never rise.
    level : (...) array
        One for all curves, or one for each.
    straight : bool
        Whether points are joined by straight lines. Default: by the monotone cubic of Fritsch & Butland 1984,
        SIAM J. Sci. Stat. Comput. 5, 300.
    """
    from scipy.interpolate import PchipInterpolator

    wanted = np.broadcast_to(level, curves.shape[:-1])
    for end in (curves[..., 0], curves[..., -1]):
        wanted = np.where(np.abs(wanted - end) < _SAME, end, wanted)
    after = np.maximum(np.argmax(curves <= wanted[..., None], axis=-1), 1)[..., None]

    def at_both(values: Floats) -> tuple[Floats, Floats]:
        values = np.broadcast_to(values, curves.shape)
        ends = (np.take_along_axis(values, index, -1)[..., 0] for index in (after - 1, after))
        return next(ends), next(ends)

    (first, last), (high, low) = at_both(places), at_both(curves)
    part = (high - wanted) / np.where(high > low, high - low, 1.0)
    if not straight:
        slopes = at_both(PchipInterpolator(places, curves, axis=-1).derivative()(places))
        part = _crossing((high, low), ((last - first) * slopes[0], (last - first) * slopes[1]), wanted)
    bounded = np.where(curves[..., -1] > wanted, np.inf, first + part * (last - first))
    return np.asarray(np.where(curves[..., 0] < wanted, -np.inf, bounded), np.float64)


def _crossing(values: tuple[Floats, Floats], slopes: tuple[Floats, Floats], level: Floats) -> Floats:
    """Return where in [0, 1] falling cubics cross a level, from their values and slopes at both ends."""
    (high, low), (slope, next_slope) = values, slopes
    start, end = np.zeros_like(high), np.ones_like(high)
    for _ in range(_HALVINGS):
        t = 0.5 * (start + end)
        rest = 1.0 - t
        value = rest**2 * ((1 + 2 * t) * high + t * slope) + t**2 * ((3 - 2 * t) * low - rest * next_slope)
        start, end = np.where(value >= level, t, start), np.where(value >= level, end, t)
    return 0.5 * (start + end)
