"""Estimators of a spot's position: classes that describe themselves completely.

A new estimator is a module like these: a frozen dataclass with its options, and either `locate` in NumPy or a
compiled kernel. `docs/estimators.md` describes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.base.options import option as option
    from faintspot.slopes.estimators.base import Estimator as Estimator
    from faintspot.slopes.estimators.base import Need as Need
    from faintspot.slopes.estimators.base import Positions as Positions
    from faintspot.slopes.estimators.base import Style as Style
    from faintspot.slopes.estimators.registry import estimator_named as estimator_named
    from faintspot.slopes.estimators.registry import estimators as estimators
    from faintspot.slopes.estimators.registry import register as register
    from faintspot.slopes.estimators.sensor import Scene as Scene
    from faintspot.slopes.estimators.sensor import Sensor as Sensor

__getattr__, __dir__, __all__ = lazy_names(__name__)
