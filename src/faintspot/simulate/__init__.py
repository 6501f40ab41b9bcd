"""Images with a known truth: spots, detectors, whole sensors."""

from faintspot.simulate.detector import Detector
from faintspot.simulate.frames import sensor_frames, subapertures
from faintspot.simulate.photometry import Photometry
from faintspot.simulate.spots import spots
from faintspot.simulate.turbulence import speckled_spots

__all__ = ["Detector", "Photometry", "sensor_frames", "speckled_spots", "spots", "subapertures"]
