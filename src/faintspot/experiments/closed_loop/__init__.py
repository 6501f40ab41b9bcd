"""Methods compared in a simulated closed loop."""
