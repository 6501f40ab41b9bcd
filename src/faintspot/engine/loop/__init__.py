"""From slopes to commands: `control_loop`, its `guard`, with new controllers, and `poking`."""
