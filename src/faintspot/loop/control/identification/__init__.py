"""What is fitted to telemetry: delay, layers, vibrations, and the controller made of them."""
