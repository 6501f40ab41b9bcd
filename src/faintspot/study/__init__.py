"""How large the slope error is, and what a method gains: Monte-Carlo experiments with a known truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

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


__getattr__ = lazy_attributes(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
