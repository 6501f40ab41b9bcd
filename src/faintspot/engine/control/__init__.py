"""From slopes to commands: `control_loop`, its `guard`, and `poking` of the mirror for its calibration."""
