"""Kinds of control: each module of this folder is one, but `base`.

A new one is a subclass of `base.ControlModel` in a module of its own: commands, configuration, simulation and
engine find it here.
"""

from __future__ import annotations

from faintspot.base.discovery import import_modules
from faintspot.loop.control.identification.models.base import ControlModel, Lesson, LoopPlant

__all__ = [
    "CONTROLS",
    "INTEGRATOR",
    "MODELS",
    "ControlModel",
    "Lesson",
    "LoopPlant",
    "predicts",
]

import_modules(__name__)

INTEGRATOR = "integrator"
"""The control that learns nothing."""
MODELS: dict[str, type[ControlModel]] = {kind.kind: kind for kind in ControlModel.__subclasses__()}
"""Models by the kind of control."""
CONTROLS = {
    INTEGRATOR: "integrator with one gain",
    **{name: model.label for name, model in MODELS.items()},
}
"""Kinds of control and their names in reports."""


def predicts(control: str) -> bool:
    """Return whether a kind of control knows the slopes of the next frame and their errors."""
    return control in MODELS and MODELS[control].predicts
