"""Measurements from the telemetry of loops. Read in this order.

Of any system: `recorded_loop` (its file), `open_loop` (slopes without the mirror), `choices` (other
controllers by replay), `report` and `page`. Of this engine: `recording` and `engine_telemetry` (its
slopes), `measured` (star, camera and turbulence), `residual`, `centroid_gain`.
"""
