"""The closed-loop experiment: what a way to measure slopes gains in Strehl ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.loop.arms import Arm as Arm
    from faintspot.loop.configuration import LoopConfiguration as LoopConfiguration
    from faintspot.loop.configuration import load_loop as load_loop
    from faintspot.loop.configuration import shipped_loops as shipped_loops
    from faintspot.loop.record import LoopRecord as LoopRecord
    from faintspot.loop.simulation import simulate_loop as simulate_loop

_HOMES = {
    "Arm": "faintspot.loop.arms",
    "LoopConfiguration": "faintspot.loop.configuration",
    "LoopRecord": "faintspot.loop.record",
    "load_loop": "faintspot.loop.configuration",
    "shipped_loops": "faintspot.loop.configuration",
    "simulate_loop": "faintspot.loop.simulation",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
