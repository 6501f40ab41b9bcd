"""What the sensor is: where its sub-apertures are, its calibration, its settings."""
