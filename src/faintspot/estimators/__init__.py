"""Estimators of a spot's position: one module each, with a class that describes itself completely.

A new estimator is a module like these: a frozen dataclass with its options, and either `locate` in NumPy or a
compiled kernel. `docs/estimators.md` describes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.config.options import option as option
    from faintspot.estimators.base import Estimator as Estimator
    from faintspot.estimators.base import Need as Need
    from faintspot.estimators.base import Positions as Positions
    from faintspot.estimators.base import Style as Style
    from faintspot.estimators.registry import estimator_named as estimator_named
    from faintspot.estimators.registry import estimators as estimators
    from faintspot.estimators.registry import register as register
    from faintspot.estimators.scene import Scene as Scene
    from faintspot.estimators.sensor import Sensor as Sensor

_HOMES = {
    "Estimator": "faintspot.estimators.base",
    "Need": "faintspot.estimators.base",
    "Positions": "faintspot.estimators.base",
    "Scene": "faintspot.estimators.scene",
    "Sensor": "faintspot.estimators.sensor",
    "Style": "faintspot.estimators.base",
    "estimator_named": "faintspot.estimators.registry",
    "estimators": "faintspot.estimators.registry",
    "option": "faintspot.config.options",
    "register": "faintspot.estimators.registry",
}

__all__ = [*sorted(_HOMES)]

__getattr__ = lazy_attributes(__name__, _HOMES)
