"""The simulated telescope: atmosphere, guide star, mirror, sensor, camera."""
