"""Slopes -> commands, and what they are worth. Read in this order.

`turbulence` (covariances of slopes), `control` (integrator, Kalman filters, identification from telemetry),
`simulation` (a telescope whose loop is closed), `telemetry` (reports of recorded loops).
"""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_packages

if TYPE_CHECKING:
    from faintspot.loop import control as control
    from faintspot.loop import simulation as simulation
    from faintspot.loop import telemetry as telemetry
    from faintspot.loop import turbulence as turbulence

__getattr__ = lazy_packages(__name__, "control simulation telemetry turbulence")
