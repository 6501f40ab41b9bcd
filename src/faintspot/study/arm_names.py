"""What an arm's name in a study stands for: an estimator, or a way to measure that only studies compare."""

from __future__ import annotations

from faintspot.compare.arms import Knowledge
from faintspot.errors import InputError
from faintspot.estimators.base import Estimator, Style
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.gravity import KeepingBrightest
from faintspot.estimators.registry import estimator_named, estimators
from faintspot.estimators.smoothed import Smoothed
from faintspot.estimators.thresholded import Thresholded
from faintspot.estimators.total_variation import TotalVariation
from faintspot.study.simple_denoisers import BrightestAsTheyAre, MedianFiltered

Kind = type[Estimator]

TV, NO_TV, SMOOTHING = TotalVariation.name, BrightestPixels.name, Smoothed.name
"""The arms that the paper's claims compare, and the simplest rival."""
TV_OVER_NO_TV = {"method": TV, "reference": NO_TV}
"""Which curves gains are taken between."""

_ONLY_HERE: dict[str, Kind] = {kind.name: kind for kind in (BrightestAsTheyAre, MedianFiltered)}
DEFAULT_ARMS = tuple(
    kind.name
    for kind in (BrightestPixels, TotalVariation, BrightestAsTheyAre, Smoothed, MedianFiltered, Thresholded)
)
"""The built-in ones that know nothing of the spot."""


def kind_of(arm: str) -> Kind:
    """Return the estimator that an arm is.

    Raises
    ------
    InputError
        For an unknown name.
    """
    known = [*estimators(), *_ONLY_HERE]
    if arm not in known:
        raise InputError(f"arms = {arm!r}: expected one of {', '.join(map(repr, known))}")
    return _ONLY_HERE.get(arm) or estimator_named(arm)


def label_of(arm: str) -> str:
    """Return what tables and figures call an arm; its name where its estimator is not installed here."""
    return kind_of(arm).label if _is_known(arm) else arm


def style_of(arm: str) -> Style:
    """Return how figures draw an arm."""
    return kind_of(arm).style if _is_known(arm) else Estimator.style


def knows_the_spot(arm: str) -> bool:
    """Whether an arm is told more than the noise."""
    return _is_known(arm) and Knowledge.of(kind_of(arm)) > Knowledge.NOISE


def is_estimator(arm: str) -> bool:
    """Whether an arm is not of studies alone."""
    return arm not in _ONLY_HERE


def keeps_every_k(kind: Kind) -> bool:
    """Whether all numbers of kept pixels are measured at once: its denoised images are known."""
    return issubclass(kind, KeepingBrightest) and kind.denoised is not KeepingBrightest.denoised


def _is_known(arm: str) -> bool:
    return arm in _ONLY_HERE or arm in estimators()
