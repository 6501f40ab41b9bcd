"""Controllers that turn slopes into mirror commands, independent of any simulation. Read in this order.

`commands` (delay line to the mirror), `base` (what every controller offers), `reconstructor` (slopes to
commands), `integrator`, `kalman` (prediction), `telemetry` (open-loop slopes), `identification` (controllers
learnt from it), `configuration` (table [control]). Beside them: `mirror_calibration`, from pokes, and
`flattening`, the command that flattens a measured wavefront.

For the loops of other systems: `Recording`, `learn` and `PredictiveControl`.
"""

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.loop.control.identification.predictive_control import (
        PredictiveControl as PredictiveControl,
    )
    from faintspot.loop.control.identification.predictive_control import learn as learn
    from faintspot.loop.control.identification.recording import Recording as Recording

_PACKAGE = "faintspot.loop.control.identification"
_HOMES = {
    "PredictiveControl": f"{_PACKAGE}.predictive_control",
    "Recording": f"{_PACKAGE}.recording",
    "learn": f"{_PACKAGE}.predictive_control",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
