"""Controllers that turn slopes into mirror commands, independent of any simulation. Read in this order.

`base` (delay line to the mirror, what every controller offers, open-loop slopes and their replay),
`reconstructor` (slopes to commands), `integrator` (and the loop for which controllers are made), `kalman`
(prediction), `identification` (controllers learnt from telemetry), `options` and `configuration` (table
[control]). Beside them: `mirror_calibration`, from pokes, and `flattening`, the command that flattens a
measured wavefront.

For the loops of other systems: `Recording`, learning and `PredictiveControl`.
"""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.loop.control.identification.predictive_control import (
        PredictiveControl as PredictiveControl,
    )
    from faintspot.loop.control.identification.predictive_control import learn as learn
    from faintspot.loop.control.identification.recording import Recording as Recording

__getattr__, __dir__, __all__ = lazy_names(__name__)
