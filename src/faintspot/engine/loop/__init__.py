"""From slopes to commands: `control_loop`, its `guard`, new controllers (`successor`), and `poking`."""
