"""Simulated images with known spot positions: spots, detectors and whole sensors."""

from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.simulate.frames import sensor_frames, subapertures
from faintspot.slopes.simulate.photometry import Photometry
from faintspot.slopes.spots.shapes import spots
from faintspot.slopes.spots.speckled import speckled_spots

__all__ = ["Detector", "Photometry", "sensor_frames", "speckled_spots", "spots", "subapertures"]
