"""Controllers that turn slopes into mirror commands, independent of any simulation. Read in this order.

`commands` (delay line to the mirror), `base` (what every controller offers), `reconstructor` (slopes to
commands), `integrator`, `kalman` (prediction), `telemetry` (open-loop slopes), `identification` (controllers
learnt from it), `configuration` (table [control]). Beside them: `mirror_calibration`, from pokes.
"""
