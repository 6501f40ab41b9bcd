"""Simulated frames of a layout."""

from typing import Any

from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import sensor_frames


def frames_of(layout: Layout, n: int, **options: Any) -> tuple[Any, Any]:
    """Return so many frames of a sensor and the positions of its spots, see `sensor_frames`."""
    return sensor_frames(layout, n, **options)
