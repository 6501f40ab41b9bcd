"""The closed-loop experiment: what a way to measure slopes gains in Strehl ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.ao_loop.configuration import LoopConfiguration as LoopConfiguration
    from faintspot.ao_loop.configuration import load_loop as load_loop
    from faintspot.ao_loop.configuration import shipped_loops as shipped_loops
    from faintspot.ao_loop.methods import Method as Method
    from faintspot.ao_loop.record import LoopRecord as LoopRecord
    from faintspot.ao_loop.simulation import simulate_loop as simulate_loop

_HOMES = {
    "Method": "faintspot.ao_loop.methods",
    "LoopConfiguration": "faintspot.ao_loop.configuration",
    "LoopRecord": "faintspot.ao_loop.record",
    "load_loop": "faintspot.ao_loop.configuration",
    "shipped_loops": "faintspot.ao_loop.configuration",
    "simulate_loop": "faintspot.ao_loop.simulation",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
