"""The camera: calibration, its measurement, and a simulated detector."""
