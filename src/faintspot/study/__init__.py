"""How large the slope error is, and what a method gains: Monte-Carlo experiments with a known truth."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from faintspot.study.cell import measure_cell as measure_cell
    from faintspot.study.running import run as run
    from faintspot.study.specification import StudySpecification as StudySpecification
    from faintspot.study.store import open_study as open_study
    from faintspot.study.sweep import Cell as Cell
    from faintspot.study.sweep import Sweep as Sweep

_HOMES = {
    "Cell": "faintspot.study.sweep",
    "StudySpecification": "faintspot.study.specification",
    "Sweep": "faintspot.study.sweep",
    "measure_cell": "faintspot.study.cell",
    "open_study": "faintspot.study.store",
    "run": "faintspot.study.running",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name from its home at first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'faintspot.study' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
