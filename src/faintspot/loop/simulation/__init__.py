"""The closed-loop experiment: what a way to measure slopes gains in Strehl ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.loop.simulation.configuration import LoopConfiguration as LoopConfiguration
    from faintspot.loop.simulation.configuration import load_loop as load_loop
    from faintspot.loop.simulation.configuration import shipped_loops as shipped_loops
    from faintspot.loop.simulation.methods import Method as Method
    from faintspot.loop.simulation.record import LoopRecord as LoopRecord
    from faintspot.loop.simulation.simulation import simulate_loop as simulate_loop

__getattr__, __dir__, __all__ = lazy_names(__name__)
