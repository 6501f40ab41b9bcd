"""Recorded frames: a configuration (`first_layout`), slopes in a file (`measuring`), and their page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_attributes

if TYPE_CHECKING:
    from faintspot.slopes.recorded.measuring import Summary as Summary
    from faintspot.slopes.recorded.measuring import measure_recorded as measure_recorded

_HOMES = {
    "Summary": "faintspot.slopes.recorded.measuring",
    "measure_recorded": "faintspot.slopes.recorded.measuring",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
