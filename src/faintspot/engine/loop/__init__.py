"""From slopes to commands: the control loop and its guard."""
