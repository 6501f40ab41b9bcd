"""Slopes -> commands, and what they are worth. Read in this order.

`slope_covariance` and `turbulence_strength` (statistics of turbulence), `control` (integrator, Kalman
filters, identification from telemetry), `simulation` (a telescope whose loop is closed), `telemetry` (reports
of recorded loops).
"""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.loop import control as control
    from faintspot.loop import simulation as simulation
    from faintspot.loop import telemetry as telemetry

__getattr__, __dir__, __all__ = lazy_names(__name__)
