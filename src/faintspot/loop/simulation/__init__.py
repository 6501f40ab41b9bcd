"""The closed-loop experiment: what a way to measure slopes gains in Strehl ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_attributes

if TYPE_CHECKING:
    from faintspot.loop.simulation.configuration import LoopConfiguration as LoopConfiguration
    from faintspot.loop.simulation.configuration import load_loop as load_loop
    from faintspot.loop.simulation.configuration import shipped_loops as shipped_loops
    from faintspot.loop.simulation.methods import Method as Method
    from faintspot.loop.simulation.record import LoopRecord as LoopRecord
    from faintspot.loop.simulation.simulation import simulate_loop as simulate_loop

_HOMES = {
    "Method": "faintspot.loop.simulation.methods",
    "LoopConfiguration": "faintspot.loop.simulation.configuration",
    "LoopRecord": "faintspot.loop.simulation.record",
    "load_loop": "faintspot.loop.simulation.configuration",
    "shipped_loops": "faintspot.loop.simulation.configuration",
    "simulate_loop": "faintspot.loop.simulation.simulation",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
